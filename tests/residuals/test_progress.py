"""The bar of closing the loop: it only moves forwards, and ends at 100 %."""

import io

import pytest

from torchrl_h2o.effects import ActionGain, BodyMass, CatalogueEntry
from torchrl_h2o.residuals.progress import EFFECTS, FORCES, OTHERS, REPORT, STAGES, LoopBar, OutOfTimeError


@pytest.fixture
def bar():
    with LoopBar(file=io.StringIO()) as bar:
        yield bar


def test_a_stage_begins_where_the_earlier_ones_end(bar):
    bar.stage(FORCES)
    assert bar.n == STAGES[EFFECTS] + STAGES[OTHERS]
    assert bar.desc.startswith(FORCES)


def test_the_bar_comes_closer_to_the_end_of_its_stage_and_never_moves_back(bar):
    bar.stage(OTHERS)
    bar.closer(0.5)
    halfway = STAGES[EFFECTS] + 0.5 * STAGES[OTHERS]
    assert bar.n == halfway
    bar.stage(EFFECTS)  # another round of the search
    assert bar.n == halfway
    for _ in range(100):
        bar.closer(0.5)
    assert bar.n == pytest.approx(STAGES[EFFECTS] + STAGES[OTHERS])


def test_the_last_stage_ends_at_100_per_cent(bar):
    bar.stage(REPORT)
    bar.finish()
    assert bar.n == bar.total == 100.0


def test_the_bar_names_the_effects_of_the_present_list(bar):
    for effect in (ActionGain(), BodyMass(bodies="torso")):
        bar.show_found([CatalogueEntry(effect, ({"scale": 0.8},))])
    assert "BodyMass torso" in str(bar)
    assert "ActionGain" not in str(bar)


def test_the_time_left_follows_from_all_the_time_passed():
    with LoopBar(file=io.StringIO(), mininterval=0.0) as bar:
        bar.start_t -= 60.0
        bar.update(50.0)
        for _ in range(100):  # the smallest steps are the last ones
            bar.update(1e-3)
        assert "about 01:0" in str(bar) or "about 00:5" in str(bar)


def test_the_search_ends_when_its_time_is_up_and_the_report_does_not():
    with LoopBar(disable=True, minutes=1e-9) as bar:
        bar.stage(EFFECTS)
        with pytest.raises(OutOfTimeError, match=EFFECTS):
            bar.closer(0.5)
        bar.stage(REPORT)
        bar.closer(0.5)


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan")])
def test_a_time_that_is_none_is_refused(minutes):
    with pytest.raises(ValueError, match="above 0"):
        LoopBar(disable=True, minutes=minutes)


def test_a_stage_that_does_not_exist_is_refused(bar):
    with pytest.raises(KeyError):
        bar.stage("waiting")
