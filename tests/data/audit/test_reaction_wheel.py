"""A pendulum swung by a reaction wheel, of which the wheel's speed alone is measured, and whose model is too light."""

import mujoco
import numpy as np
import pytest

from tests.data.audit import recorded as logs
from torchrl_h2o.data import audit
from torchrl_h2o.effects import Armature
from torchrl_h2o.residuals import Simulation, StateMap

XML = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.005"/>
  <worldbody>
    <body>
      <joint name="theta" axis="0 1 0"/>
      <inertial pos="0 0 -0.09" mass="0.12" diaginertia="2e-4 2e-4 1e-5"/>
      <body pos="0 0 -0.14">
        <joint name="phi" axis="0 1 0"/>
        <inertial pos="0 0 0" mass="0.02" diaginertia="5e-5 1e-4 5e-5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="u" joint="phi" gear="0.06" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
HEAVY = Armature(0.011, "theta")  # eight times the inertia that the model has
TIME = 0.05 * np.arange(700)
ACTIONS = {
    "chirp": 0.15 * np.sin((1.0 + 0.06 * TIME) * TIME),
    "slow chirp": 0.2 * np.sin((0.5 + 0.05 * TIME) * TIME),
    "sine": 0.1 * np.sin(2.0 * np.pi * TIME / 1.8),
}


def recorded(action: np.ndarray, *effects):
    """A log of the rig, with a wheel whose angle is not observed, and its simulation without effects."""
    names, units = ("theta", "theta_velocity", "phi_velocity"), ("rad", "rad/s", "rad/s")
    state_map = StateMap.of_coordinates(names, units, (0, 2, 3), num_states=4)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(XML), 10, state_map, (), "reaction wheel")
    reached = simulation.with_effects(*effects).rollout(np.zeros((1, 4)), action[None, :, None])[0]
    observed = np.vstack([np.zeros(4), reached])[:, [0, 2, 3]]
    observed += 0.01 * observed.std(0) * np.random.default_rng(0).standard_normal(observed.shape)
    return observed, simulation


def measured(observed: np.ndarray, action: np.ndarray):
    return logs.measured(observed, action[:, None], TIME[: len(action)])


@pytest.mark.parametrize("name", ACTIONS)
def test_wheel_that_follows_its_motor_outweighs_a_pendulum_of_the_wrong_inertia(name):
    observed, simulation = recorded(ACTIONS[name], HEAVY)
    found = audit(measured(observed, ACTIONS[name]), simulation)
    assert found.severe == found.warnings == ()
    assert any("far better with rotors on its joints" in finding.words for finding in found.findings)


@pytest.mark.parametrize("rows", [300, 700])
def test_nothing_is_wrong_with_the_right_inertia(rows):
    action = ACTIONS["slow chirp"][:rows]
    observed, simulation = recorded(action, HEAVY)
    found = audit(measured(observed, action), simulation.with_effects(HEAVY))
    assert found.severe == found.warnings == ()


def test_late_actions_of_the_wheel_are_still_found():
    action = ACTIONS["chirp"]
    observed, simulation = recorded(action, HEAVY)
    found = audit(measured(observed[:-10], action[10:]), simulation.with_effects(HEAVY))
    assert ["10 rows (500 ms) later" in finding.words for finding in found.severe] == [True]


def test_sign_of_the_wheel_is_still_found():
    action = ACTIONS["chirp"]
    observed, simulation = recorded(action, HEAVY)
    found = audit(measured(observed, -action), simulation.with_effects(HEAVY))
    assert ["the action of u has the other sign" in finding.words for finding in found.severe] == [True]


def test_a_pendulum_without_its_wheel_blames_no_repeated_action():
    """A sine that acts one period later is the same sine."""
    action = ACTIONS["sine"]
    observed, simulation = recorded(action, HEAVY)
    state_map = StateMap.of_coordinates(("theta", "theta_velocity"), ("rad", "rad/s"), (0, 2), num_states=4)
    alone = Simulation(simulation.spec, 10, state_map, (HEAVY,), "pendulum")
    found = audit(measured(observed[:, :2], action), alone)
    assert not [finding for finding in found.severe if "rows" in finding.words]
