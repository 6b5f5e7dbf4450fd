"""The clause about forces that the measured motion would need with the effects found."""

from dataclasses import replace

import mujoco
import numpy as np

from tests.residuals.pendulum import XML, double_pendulum, pendulum
from torchrl_h2o.residuals.judge.needs_more_force import needs_more_force
from torchrl_h2o.residuals.measured.missing_force import MissingForces


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
