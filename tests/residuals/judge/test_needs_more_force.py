"""The clause about forces that the measured motion would need with the effects found."""

from dataclasses import replace

import mujoco
import numpy as np

from tests.residuals.pendulum import XML, double_pendulum, pendulum
from torchrl_h2o.effects import Armature, Gravity, JointFrictionLoss
from torchrl_h2o.residuals.judge.needs_more_force import needs_more_force
from torchrl_h2o.residuals.judge.verdict import _raises_its_forces
from torchrl_h2o.residuals.measured.missing_force import MissingForces
from torchrl_h2o.residuals.settings import DEFAULTS


def test_the_joint_with_the_largest_rise_is_named_with_its_torques():
    forces = MissingForces(np.array([0.2, 0.1]), np.array([0.3, 1.25]))
    (clause,) = needs_more_force(double_pendulum(), forces)
    assert clause == (
        "with the effects found, 1.2 N·m is missing in the measured motion of elbow, and 0.1 N·m without them"
    )


def test_a_sliding_joint_has_forces():
    sliding = replace(pendulum(), spec=lambda: mujoco.MjSpec.from_string(XML.replace('"hinge"', '"slide"')))
    (clause,) = needs_more_force(sliding, MissingForces(np.array([0.2]), np.array([2.0])))
    assert "2 N is missing in the measured motion of elbow, and 0.2 N without them" in clause


def test_nothing_is_said_of_effects_that_lower_the_forces():
    assert needs_more_force(pendulum(), MissingForces(np.array([0.2]), np.array([0.1]))) == ()


def test_an_effect_is_judged_by_the_forces_of_its_own_joints():
    """Right friction of the shoulder must not excuse a rotor at the elbow that raises the force there."""
    forces, rules = MissingForces(np.array([1.0, 1.0]), np.array([0.1, 1.3])), DEFAULTS.verdict
    mended = double_pendulum()
    assert _raises_its_forces(Armature(0.1, "elbow"), mended, forces, rules)
    assert not _raises_its_forces(JointFrictionLoss(0.1, "shoulder"), mended, forces, rules)
    assert not _raises_its_forces(Gravity(0.9), mended, forces, rules)
