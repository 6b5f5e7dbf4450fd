"""Dry friction beside noise of the actions of its size."""

import mujoco
import pytest

from torchrl_h2o.effects import ActionNoise, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.judge.caveats import friction_beside_noise

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


def simulation_of(xml: str) -> Simulation:
    names = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
    state_map = StateMap.of_coordinates(names, ("rad", "rad", "rad/s", "rad/s"), (0, 1, 2, 3), num_states=4)
    return Simulation(lambda: mujoco.MjSpec.from_string(xml), 2, state_map, (), "arm")


@pytest.fixture(scope="module")
def simulation():
    return simulation_of(ARM)


def said(simulation, *effects):
    return friction_beside_noise(simulation, simulation.with_effects(*effects), effects)


def test_friction_beside_as_much_noise_may_be_too_large(simulation):
    (words,) = said(simulation, JointFrictionLoss(0.7, "elbow"), ActionNoise(0.9))
    assert "of 0.9 N·m beside the + 0.7 N·m of elbow. On a light link" in words


def test_the_noise_of_a_geared_motor_counts_as_a_torque(simulation):
    effects = JointFrictionLoss(0.7, "shoulder"), ActionNoise(0.09)
    assert "of 0.9 N·m beside the + 0.7 N·m of shoulder" in said(simulation, *effects)[0]


def test_all_such_joints_are_named(simulation):
    (words,) = said(simulation, JointFrictionLoss(0.9), ActionNoise(0.9))
    assert "N·m of shoulder, of 0.9 N·m beside the + 0.9 N·m of elbow" in words


def test_a_control_that_cannot_be_zero_counts_too():
    spec = mujoco.MjSpec.from_string(ARM)
    spec.actuators[1].ctrllimited, spec.actuators[1].ctrlrange = True, [1.0, 5.0]
    positive = simulation_of(spec.to_xml())
    assert "+ 0.7 N·m of elbow" in said(positive, JointFrictionLoss(0.7, "elbow"), ActionNoise(0.9))[0]


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
