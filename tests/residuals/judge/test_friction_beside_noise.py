"""Dry friction beside noise of the actions of its size."""

import mujoco
import pytest

from torchrl_h2o.effects import ActionNoise, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.judge.friction_beside_noise import friction_beside_noise

ARM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/>
      <body pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder" gear="10"/><motor joint="elbow"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def simulation():
    names = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
    state_map = StateMap.of_coordinates(names, ("rad", "rad", "rad/s", "rad/s"), (0, 1, 2, 3), num_states=4)
    return Simulation(lambda: mujoco.MjSpec.from_string(ARM), 2, state_map, (), "arm")


def said(simulation, *effects):
    return friction_beside_noise(simulation, simulation.with_effects(*effects), effects)


def test_friction_beside_as_much_noise_may_be_too_large(simulation):
    (words,) = said(simulation, JointFrictionLoss(0.7, "elbow"), ActionNoise(0.9))
    assert "as large as the dry friction of elbow, 0.7 N·m: on a light link, such friction may be" in words


def test_the_noise_of_a_geared_motor_counts_as_a_torque(simulation):
    effects = JointFrictionLoss(0.7, "shoulder"), ActionNoise(0.09)
    assert "of shoulder, 0.7 N·m" in said(simulation, *effects)[0]


def test_all_such_joints_are_named(simulation):
    assert "of shoulder, 0.9 N·m and of elbow, 0.9 N·m" in said(simulation, JointFrictionLoss(0.9), ActionNoise(0.9))[0]


@pytest.mark.parametrize(
    "effects",
    [
        (JointFrictionLoss(0.7, "elbow"), ActionNoise(0.4)),
        (JointFrictionLoss(0.7, "elbow"), ActionNoise(0.9, (0,))),  # at the other joint
        (JointFrictionLoss(0.7, "elbow"), ActionNoise(-0.9)),  # reality has less noise than the simulator
        (JointDamping(0.7), ActionNoise(0.9)),
        (JointFrictionLoss(0.7, "elbow"),),
    ],
    ids=["less noise", "other joint", "noise taken off", "no dry friction", "no noise"],
)
def test_nothing_is_said_otherwise(simulation, effects):
    assert said(simulation, *effects) == ()
