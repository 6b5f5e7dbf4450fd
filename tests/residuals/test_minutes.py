"""The time of a search and of its report: each ends within it, and the report says what is missing."""

from dataclasses import replace

import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointFrictionLoss
from torchrl_h2o.residuals import Report, close_the_loop, explain, gather_evidence
from torchrl_h2o.residuals.compose_report import compose_report
from torchrl_h2o.residuals.judge.judgement import judge
from torchrl_h2o.residuals.progress import REPORT, LoopBar
from torchrl_h2o.residuals.report.contents import UNDECIDED, Verdict

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))


def closed_within(seconds, measured, catalogue=(GRAVITY, FRICTION), evaluation=0.5, slow=-1.0):
    """The report, and the time that it took, on a clock on which each call of MuJoCo takes a second.

    The call after ``slow`` seconds takes 0.9 of the whole time.
    """
    now = 0.0

    def tick():
        nonlocal now
        now += 0.9 * seconds if now == slow else 1.0
        bar.check()

    with LoopBar(disable=True, minutes=seconds / 60.0, clock=lambda: now) as bar:
        bar.keep_for_report(evaluation)
        evidence = gather_evidence(replace(SIMULATION, check=tick), measured)
        explanation = explain(evidence, catalogue, progress=bar)
        bar.stage(REPORT)
        report = compose_report(evidence, explanation, judge(evidence, explanation, catalogue, progress=bar))
    return report, now


@pytest.fixture(scope="module")
def swings():
    return recorded(SIMULATION.with_effects(Gravity(1.3)), 800)


@pytest.mark.parametrize("seconds", [40, 150])
def test_search_and_report_take_no_longer_than_they_may(swings, seconds):
    report, taken = closed_within(seconds, swings)
    assert taken <= seconds + 1
    assert Report.from_json(report.to_json()).sentence() == report.sentence()


def test_a_search_that_was_cut_short_recommends_nothing_and_says_so(swings):
    report, _ = closed_within(100, swings)
    assert report.preliminary
    assert not report.recommended
    assert report.verdict is not None
    assert not report.verdict.recommended
    assert "The time for the search was up while it was looking for" in report.sentence()
    assert "this catalogue does not explain" not in report.sentence()


def test_until_something_is_found_the_search_may_use_most_of_the_report_s_time(swings):
    report, taken = closed_within(100, swings, evaluation=1e3)  # a whole report would take a third of the time
    assert "gravity × 1.3" in report.sentence()
    assert "the verdict" in report.left_out
    assert taken <= 101


def test_parts_of_the_report_for_which_there_is_no_time_are_named():
    measured = recorded(SIMULATION.with_effects(Gravity(1.3)), 800)
    report, taken = closed_within(60, measured, evaluation=1e-3)
    assert taken <= 61
    assert report.left_out
    assert "The time was up before these parts of the report were computed: " in report.sentence()
    assert all(part in report.sentence() for part in report.left_out)
    assert Report.from_json(report.to_json()).left_out == report.left_out


def test_a_search_whose_time_is_up_does_not_say_that_nothing_is_missing():
    """No test on so few and noisy rows shows this gravity; the whole search finds it."""
    measured = recorded(SIMULATION.with_effects(Gravity(1.06)), 600, noise=0.02)
    report, _ = closed_within(3000, measured, [GRAVITY], slow=20.0)
    assert report.verdict.kind == UNDECIDED
    assert not report.verdict.undetectable
    assert report.sentence().startswith("Nothing was found so far, and no test shows that something is missing")
    no_verdict = replace(report, verdict=Verdict(UNDECIDED, ("the time was up before a verdict was reached",)))
    assert no_verdict.sentence().startswith("Nothing was found so far, and the time was up before a verdict")


def test_minutes_in_which_no_search_can_begin_are_named_in_one_line(swings):
    report = close_the_loop(SIMULATION, swings, [GRAVITY], minutes=1e-9, progress=False)
    assert report.sentence().startswith("No conclusion: the time was up while measuring the residual")
    assert report.sentence().endswith("; give more minutes.")
