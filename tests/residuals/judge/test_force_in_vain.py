"""The clause about a force outside the catalogue that no measured motion needs."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import JointFrictionLoss, ResidualForce
from torchrl_h2o.residuals.judge.needs_more_force import force_in_vain

SIMULATION = double_pendulum()
AGAINST_THE_TORQUE = ResidualForce(("torque on elbow: -0.3 · a1",))
FRICTION = ResidualForce(("torque on elbow: -0.1 · sign(v)",))
BOTH = ResidualForce(("torque on elbow: -0.1 · sign(v)", "torque on shoulder: -0.3 · a0"))


def clauses(truth, found):
    """The clauses about effects that were found in data with noisy torques."""
    measured = recorded(SIMULATION.with_effects(*truth), 3000, noise=0.002)
    noise = 0.1 * np.random.default_rng(1).normal(size=measured.action.shape)
    noisy = replace(measured, action=measured.action + noise)
    return force_in_vain(SIMULATION, SIMULATION.with_effects(*found), noisy, found)


@pytest.mark.parametrize(("found", "joint"), [(AGAINST_THE_TORQUE, "elbow"), (BOTH, "shoulder")])
def test_a_force_that_lowers_nothing_at_its_joint_is_named(found, joint):
    truth = (JointFrictionLoss(0.1, "elbow"),) if found is BOTH else ()
    (clause,) = clauses(truth, (found,))
    assert clause == f"as much force is missing in the measured motion of {joint} with the force found as without it"


def test_the_missing_force_is_not_in_vain():
    assert clauses((JointFrictionLoss(0.1, "elbow"),), (FRICTION,)) == ()


def test_effects_of_the_catalogue_are_not_judged_by_it():
    assert clauses((), (JointFrictionLoss(0.1, "elbow"),)) == ()
