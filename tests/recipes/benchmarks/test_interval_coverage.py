"""The benchmark of intervals counts which values are inside."""

import pytest
from interval_coverage import LeftOut, counts


def left_out(own, true=None):
    return LeftOut("friction", 0, value=1.0, half_width=0.3, own=own, own_half_width=0.4, true=true)


def test_a_value_is_counted_inside_the_interval_and_inside_the_one_widened_by_its_own_error():
    rows = [left_out(own, true) for own, true in ((1.2, 1.31), (0.69, 0.71), (0.51, 1.0), (1.6, None))]
    assert counts(rows) == {"values": 4, "inside": 1, "inside_widened": 3, "truths": 3, "truths_inside": 2}


def test_the_distance_of_a_value_counts_both_errors():
    assert left_out(1.5).z == pytest.approx(1.96)
    assert left_out(0.0).z == pytest.approx(-3.92)
