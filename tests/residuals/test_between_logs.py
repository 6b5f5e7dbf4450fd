"""Several logs of one machine: which values agree between them, which do not, and which a log does not contain."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from tests.residuals.pendulum import double_pendulum, pendulum, recorded
from tests.residuals.report.made_up_reports import few_pictures, full_report
from tests.residuals.test_search import together
from torchrl_h2o.effects import BodyMass, Gravity, JointDamping, JointFrictionLoss
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.residuals import close_the_loop
from torchrl_h2o.residuals.between_logs import InLogs, half_widths_between
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.intervals import CONFIDENCE
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.page import report_page
from torchrl_h2o.residuals.search import with_intervals

SIMULATION = pendulum()
KINDS = JointFrictionLoss, BodyMass
CATALOGUE = [entry for entry in SIMULATION.catalogue() if isinstance(entry.effect, KINDS)]
MASS = next(entry.effect for entry in CATALOGUE if isinstance(entry.effect, BodyMass)).with_parameters({"scale": 1.3})


def logs(*frictions, rows=900):
    """A log with each friction, in N·m, of a pendulum of one mass."""
    return [
        recorded(SIMULATION.with_effects(JointFrictionLoss(friction, "elbow"), MASS), rows, noise=0.01, seed=seed)
        for seed, friction in enumerate(frictions)
    ]


def fitted(parts):
    effects = JointFrictionLoss(0.05, "elbow"), MASS
    ground = Ground.of(SIMULATION, together(parts))
    return with_intervals(ground, ground.found([entry_of(effect, CATALOGUE) for effect in effects], effects), [])


def test_a_report_says_that_the_friction_differs_between_logs_and_the_mass_does_not(tmp_path):
    report = close_the_loop(SIMULATION, together(logs(0.03, 0.05, 0.07)), CATALOGUE, progress=False)
    friction, mass = sorted(report.found, key=lambda one: one.name, reverse=True)
    assert friction.in_logs["torque"].values == pytest.approx((0.03, 0.05, 0.07), abs=0.004)
    assert not friction.in_logs["torque"].agree
    assert mass.in_logs["scale"].agree
    assert f"The 3 fitted logs agree on {mass.words}." in report.sentence()
    assert f"The 3 fitted logs differ in {friction.words} (" in report.sentence()
    loaded = Report.load(report.save(tmp_path))
    assert loaded.found == report.found
    assert "differ, 0.0" in report_page(loaded)


def test_equal_logs_agree():
    _, fit, _ = fitted(logs(0.05, 0.05, 0.05))
    assert [one.agree for own in fit.in_logs for one in own.values()] == [True, True]
    assert {kind for own in fit.in_logs for one in own.values() for kind in one.kinds} == {"identifiable"}


def test_one_log_has_nothing_to_agree_with():
    measured = replace(logs(0.05)[0], log=None)
    report = close_the_loop(SIMULATION, measured, CATALOGUE, progress=False)
    assert all(not found.in_logs for found in report.found)
    assert "logs" not in report.sentence()


def test_a_log_at_rest_contains_no_value_and_does_not_widen_the_intervals():
    moving = logs(0.05, 0.05)
    still = {name: np.zeros_like(getattr(moving[0], name)) for name in ("observation", "following", "action")}
    rest = replace(moving[0], **still)
    (_, two, _), (_, three, _) = fitted(moving), fitted([*moving, rest])
    for own, more, name in zip(two.in_another_log, three.in_another_log, ("torque", "scale"), strict=True):
        assert more[name] == pytest.approx(own[name], rel=0.3)
    assert {own.kinds[2] for each in three.in_logs for own in each.values()} == {"not identifiable"}


def test_what_is_not_linear_in_a_value_that_differs_does_not_make_another_one_differ():
    simulation = double_pendulum()
    parts = [
        recorded(simulation.with_effects(JointDamping(damping, "elbow"), Gravity(1.3)), 800, noise=0.01, seed=seed)
        for seed, damping in enumerate((0.02, 0.03, 0.04))
    ]
    effects = JointDamping(0.03, "elbow"), Gravity(1.3)
    entries = [entry_of(effect, simulation.catalogue()) for effect in effects]
    ground = Ground.of(simulation, together(parts))
    _, fit, _ = with_intervals(ground, ground.found(entries, effects), [])
    assert fit.in_logs[0]["damping"].values == pytest.approx((0.02, 0.03, 0.04), abs=0.001)
    assert not fit.in_logs[0]["damping"].agree
    assert fit.in_logs[1]["scale"].agree


def test_a_report_names_the_logs_that_do_not_contain_a_value_and_keeps_them_in_its_file(tmp_path):
    report = few_pictures(full_report())
    gravity, mass, friction = report.found
    gravity = replace(gravity, in_logs={"scale": InLogs((0, 1, 2), (0.5, 0.5, 0.5), (0.01, 0.3, math.inf), 0.5)})
    mass = replace(mass, in_logs={"scale": InLogs((0, 1, 2), (1.2, 1.2, 1.2), (0.01, math.inf, math.inf), 0.2)})
    report = replace(report, found=(gravity, mass, friction))
    words = report.sentence()
    assert "The 3 fitted logs agree on gravity × 0.5." in words
    assert "Not every log contains gravity × 0.5 (weak in log 1, not identifiable in log 2) and mass" in words
    loaded = Report.load(report.save(tmp_path))
    assert loaded.found == report.found
    assert "in one log only" in report_page(loaded)


@pytest.mark.parametrize(("second", "word"), [(0.5000001, "agree on"), (0.52, "differ in")])
def test_logs_do_not_differ_by_less_than_the_digits_that_a_report_shows(second, word):
    gravity, mass, friction = few_pictures(full_report()).found
    gravity = replace(gravity, in_logs={"scale": InLogs((0, 1), (0.5, second), (1e-9, 1e-9), 0.5)})
    report = replace(few_pictures(full_report()), found=(gravity, mass, friction))
    assert f"The 2 fitted logs {word} gravity × 0.5" in report.sentence()


@pytest.mark.parametrize("scatter", [0.0, 1.0, 2.0, 10.0])
@pytest.mark.parametrize("logs", [2, 4])
def test_the_value_of_another_log_lies_in_the_interval_of_a_few_logs(logs, scatter):
    """Also where the scatter between logs is about as large as their errors, so that they may agree by chance."""
    rng, draws = np.random.default_rng(0), 2000
    errors = np.exp(0.3 * rng.standard_normal((logs, draws)))
    values = scatter * rng.standard_normal((logs, draws)) + errors * rng.standard_normal((logs, draws))
    total = (errors**-2.0).sum(0)
    mean = (values / errors**2).sum(0) / total
    half = np.hypot(CONFIDENCE / np.sqrt(total), half_widths_between(values, errors**2))
    share = (np.abs(scatter * rng.standard_normal(draws) - mean) < half).mean()
    assert 0.935 < share <= (1.0 if scatter < 1.0 else 0.985)


def test_a_log_that_does_not_contain_a_value_changes_no_interval():
    values, errors = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [9.0, 9.0]]), np.full((4, 2), 0.1)
    errors[3] = np.inf
    half = half_widths_between(values, errors**2)
    assert half == pytest.approx(half_widths_between(values[:3], errors[:3] ** 2))
    assert half == pytest.approx(student.ppf(0.975, 2) * np.sqrt(1.0 + 1.0 / 3.0), rel=0.03)  # errors are small
    for known in (1, 0):
        errors[known:] = np.inf
        assert (half_widths_between(values, errors**2) == 0.0).all()
