"""Screening: the missing entry has the highest promise and starts near the truth; impossible entries are skipped."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import (
    ActionDelay,
    ActionNoise,
    CatalogueEntry,
    Gravity,
    GravityTilt,
    JointDamping,
    JointFrictionLoss,
)
from torchrl_h2o.residuals import Split
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import Lead, free_parameters, screen, unlike

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 0.05}, {"damping": -0.05}))
DELAY = CatalogueEntry(ActionDelay(), ({"delay": 0.006}, {"delay": 0.02}))


def screened(truth, entries, known=(), **kwargs):
    problem = Problem.pose(SIMULATION, recorded(SIMULATION.with_effects(*truth), 600))
    return screen(problem, known, entries, problem.measured.windows(1, split=Split.FIT), **kwargs)


@pytest.mark.parametrize(
    ("truth", "entry"),
    [(Gravity(1.3), GRAVITY), (JointFrictionLoss(0.05), FRICTION), (ActionDelay(0.013), DELAY)],
    ids=lambda value: getattr(value, "name", ""),
)
def test_the_entry_that_is_missing_promises_most(truth, entry):
    leads = screened([truth], [DAMPING, GRAVITY, FRICTION, DELAY])
    assert leads[0].entry == entry
    assert [lead.promise for lead in leads] == sorted((lead.promise for lead in leads), reverse=True)


def test_a_fit_starts_near_the_truth_also_beyond_the_trials():
    (lead,) = screened([Gravity(1.4)], [GRAVITY])
    assert lead.effect.scale == pytest.approx(1.4, rel=0.02)
    assert lead.promise > 0.95


def test_the_trial_in_the_right_direction_is_taken():
    (less,), (more,) = (screened([JointDamping(value)], [DAMPING]) for value in (-0.06, 0.06))
    assert less.effect.damping < 0.0 < more.effect.damping


def test_effects_that_are_known_are_in_already():
    (lead,) = screened([Gravity(1.3), JointFrictionLoss(0.03)], [FRICTION], known=[Gravity(1.3)])
    assert lead.effect.torque == pytest.approx(0.03, rel=0.3)
    assert lead.promise > 0.8


def test_an_entry_without_a_part_in_it_promises_little():
    """Its start is not neutral, because a fit would see no gradient there."""
    leads = {lead.entry.name: lead for lead in screened([Gravity(1.3)], [GRAVITY, FRICTION])}
    assert leads[FRICTION.name].promise < 0.2 < leads[GRAVITY.name].promise
    assert not leads[FRICTION.name].effect.is_neutral


def test_what_the_model_cannot_have_and_what_is_random_is_passed_over():
    impossible = CatalogueEntry(JointDamping(), ({"damping": -0.5},))
    noise = CatalogueEntry(ActionNoise(), ({"std": 0.1},))
    assert [lead.entry for lead in screened([Gravity(1.3)], [impossible, noise, GRAVITY])] == [GRAVITY]


def test_one_impossible_trial_does_not_rule_out_the_others():
    entry = CatalogueEntry(JointDamping(), ({"damping": -0.5}, {"damping": 0.05}))
    (lead,) = screened([JointDamping(0.05)], [entry])
    assert lead.effect.damping == pytest.approx(0.05, rel=0.05)


def test_progress_advances_once_an_entry():
    seen = []
    screened([Gravity(1.3)], [GRAVITY, FRICTION, DELAY], advance=lambda: seen.append(1))
    assert len(seen) == 3


def test_free_parameters_are_those_that_any_trial_moves():
    tilt = CatalogueEntry(GravityTilt(), ({"pitch": 0.1, "roll": 0.1}, {"pitch": -0.1, "roll": 0.1}))
    assert free_parameters(tilt) == ("pitch", "roll")
    assert free_parameters(GRAVITY) == ("scale",)


def test_screening_changes_no_data():
    measured = recorded(SIMULATION.with_effects(Gravity(1.3)), 300)
    before = measured.observation.copy()
    screen(Problem.pose(SIMULATION, measured), (), [GRAVITY], measured.windows(1))
    np.testing.assert_array_equal(measured.observation, before)


def test_an_entry_that_changes_the_residual_as_an_earlier_one_does_is_left_out():
    def lead(promise, change):
        return Lead(GRAVITY, Gravity(1.1), promise, {}, np.array(change, np.float32))

    leads = [lead(0.9, [1.0, 0.0]), lead(0.8, [-2.0, 0.001]), lead(0.7, [1.0, 1.0]), lead(0.6, [0.0, 0.0])]
    assert unlike(leads, same=0.999) == [leads[0], leads[2]]
