"""A pendulum swung by a reaction wheel, of which the wheel's speed alone is measured, and whose model is too light."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.data.audit import recorded as logs
from torchrl_h2o.data import audit
from torchrl_h2o.effects import Armature, JointDamping, JointFrictionLoss
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
FRICTION = JointDamping(7.4e-5, "phi"), JointFrictionLoss(2.7e-4, "phi"), JointDamping(0.0025, "theta")
TIME = 0.05 * np.arange(994)
CHIRP = 0.15 * np.sin((0.55 + 0.033 * TIME) * TIME)
ACTIONS = {"chirp": CHIRP, "short": CHIRP[:300], "sine": 0.1 * np.sin(np.pi * TIME)}


def recorded(action: np.ndarray):
    """A log of the rig, whose wheel's angle is not observed, and its simulation, too light and without friction."""
    names, units = ("theta", "theta_velocity", "phi_velocity"), ("rad", "rad/s", "rad/s")
    state_map = replace(StateMap.of_coordinates(names, units, (0, 2, 3), num_states=4), hidden=(1,))
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(XML), 10, state_map, (), "reaction wheel")
    reached = simulation.with_effects(HEAVY, *FRICTION).rollout(np.zeros((1, 4)), action[None, :, None])[0]
    rng, rows = np.random.default_rng(0), np.vstack([np.zeros(4), reached])
    theta = rows[:, 0] + 1.5e-4 * rng.standard_normal(len(rows))
    return np.stack([theta, np.gradient(theta, 0.05), rows[:, 3] + 0.3 * rng.standard_normal(len(rows))], 1), simulation


def measured(observed: np.ndarray, action: np.ndarray):
    return logs.measured(observed, action[:, None], TIME[: len(action)])


@pytest.mark.parametrize("inertia", ["light", "right"])
@pytest.mark.parametrize("name", ACTIONS)
def test_wheel_that_follows_its_motor_outweighs_the_pendulum(name, inertia):
    """Of the pendulum alone, the audit said that actions came early or late, or belonged to another run."""
    observed, simulation = recorded(ACTIONS[name])
    simulation = simulation.with_effects(HEAVY) if inertia == "right" else simulation
    found = audit(measured(observed, ACTIONS[name]), simulation)
    assert found.severe == found.warnings == ()
    assert any("far better with rotors" in finding.words for finding in found.findings) == (inertia == "light")


def test_late_actions_of_the_wheel_are_still_found():
    action = ACTIONS["chirp"]
    observed, simulation = recorded(action)
    found = audit(measured(observed[:-10], action[10:]), simulation.with_effects(HEAVY))
    (late,) = found.severe
    assert int(re.findall(r"the actions act (\d+) rows .* later", late.words)[0]) == pytest.approx(10, abs=2)


def test_sign_of_the_wheel_is_still_found():
    action = ACTIONS["chirp"]
    observed, simulation = recorded(action)
    found = audit(measured(observed, -action), simulation.with_effects(HEAVY))
    assert ["the action of u has the other sign" in finding.words for finding in found.severe] == [True]


def test_a_pendulum_without_its_wheel_blames_no_repeated_action():
    """A sine that acts one period later is the same sine."""
    action = ACTIONS["sine"]
    observed, simulation = recorded(action)
    state_map = StateMap.of_coordinates(("theta", "theta_velocity"), ("rad", "rad/s"), (0, 2), num_states=4)
    alone = Simulation(simulation.spec, 10, state_map, (HEAVY,), "pendulum")
    found = audit(measured(observed[:, :2], action), alone)
    assert not [finding for finding in found.severe if "rows" in finding.words]


def test_a_wheel_alone_is_audited_without_any_position():
    action = ACTIONS["chirp"]
    observed, simulation = recorded(action)
    state_map = StateMap.of_coordinates(("phi_velocity",), ("rad/s",), (3,), num_states=4)
    alone = Simulation(simulation.spec, 10, state_map, (), "wheel")
    assert audit(measured(observed[:, 2:], action), alone).severe == ()
    (sign,) = audit(measured(observed[:, 2:], -action), alone).severe
    assert "the action of u has the other sign" in sign.words
