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


def test_each_part_ends_when_its_time_is_up_and_all_within_the_minutes():
    now = 0.0
    with LoopBar(disable=True, minutes=1.0, clock=lambda: now) as bar:
        bar.keep_for_report(evaluation=0.1)  # the report takes many of them
        bar.stage(EFFECTS)
        now = 50.0  # nothing is found that would have to be judged
        bar.closer(0.5)
        bar.has_result()
        with pytest.raises(OutOfTimeError, match=EFFECTS):
            bar.closer(0.5)
        bar.begin_last_fit(anything_found=True)
        bar.check()
        now = 53.0
        with pytest.raises(OutOfTimeError):
            bar.check()
        bar.begin_last_fit(anything_found=False)
        bar.check()
        bar.stage(REPORT)
        assert bar.within_time("errors", lambda: 3, 0) == 3
        now = 60.0
        assert bar.within_time("the floor", lambda: 3, 0) == 0
        assert bar.left_out == ["the floor"]


def test_the_search_ends_earlier_where_simulating_takes_longer():
    ends = []
    for evaluation in (1e-3, 0.2, 1e3):
        now = 0.0
        with LoopBar(disable=True, minutes=1.0, clock=lambda: now) as bar:  # noqa: B023
            bar.keep_for_report(evaluation)
            bar.has_result()
            while not bar.time_is_up:
                now += 1.0
        ends.append(now)
    assert 30.0 < ends[2] < ends[1] < ends[0] < 60.0


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan"), "8"])
def test_a_time_that_is_none_is_refused(minutes):
    with pytest.raises(ValueError, match="above 0"):
        LoopBar(disable=True, minutes=minutes)


def test_a_stage_that_does_not_exist_is_refused(bar):
    with pytest.raises(KeyError):
        bar.stage("waiting")
