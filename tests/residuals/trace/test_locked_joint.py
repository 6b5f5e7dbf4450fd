"""A joint that does not move is reported as locked, not as one with a heavy rotor or much friction."""

from dataclasses import replace

import mujoco
import numpy as np

from tests.residuals.pendulum import DOUBLE, double_pendulum, recorded
from torchrl_h2o.effects import Armature, JointDamping, JointRange
from torchrl_h2o.effects.model.joint import LOCKED
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar

XML = DOUBLE.replace('name="elbow" type="hinge"', 'name="elbow" type="hinge" limited="true" range="-1.5 1.5"')


def test_a_locked_joint_is_a_range_of_next_to_nothing():
    simulation = replace(double_pendulum(), spec=lambda: mujoco.MjSpec.from_string(XML))
    of_elbow = [
        entry
        for entry in simulation.catalogue()
        if isinstance(entry.effect, JointRange | Armature | JointDamping) and "elbow" in entry.name
    ]
    measured = recorded(simulation.with_effects(JointRange(LOCKED, "elbow")), 600)
    with LoopBar(disable=True) as bar:
        found = trace_effects(simulation, measured, of_elbow, rng=np.random.default_rng(0), progress=bar)
    (effect,) = found.fit.effects
    assert isinstance(effect, JointRange)
    assert effect.scale < 3.0 * LOCKED
