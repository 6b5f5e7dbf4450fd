"""The quantity that the report's sentence names."""

from dataclasses import replace

import mujoco
import numpy as np

from tests.residuals.pendulum import recorded
from torchrl_h2o.effects import BodyMass
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.judge.headline import headline_error, headline_horizon

XML = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="1"/><geom size="0.1" mass="1"/></body>
    <body name="other" pos="0 1 0"><joint name="idle" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="rail"/></actuator>
</mujoco>
"""


def test_a_reading_that_is_noise_alone_is_not_the_sentence_s():
    """The idle joint's readings spread as its noise does, so in spreads its error is the largest."""
    names, units = ("rail", "idle", "rail_velocity", "idle_velocity"), ("m", "m", "m/s", "m/s")
    state_map = StateMap.of_coordinates(names, units, (0, 1, 2, 3), num_states=4)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(XML), 1, state_map)
    rng, action = np.random.default_rng(0), np.zeros((1500, 1))
    for row in range(1, len(action)):
        action[row] = 0.95 * action[row - 1] + rng.standard_normal(1)
    heavy = simulation.with_effects(BodyMass(1.5, bodies="cart"))
    rows = np.vstack([np.zeros(4), heavy.rollout(np.zeros((1, 4)), action[None])[0]])
    rows += np.array([0.002, 0.002, 0.01, 0.01]) * rng.standard_normal(rows.shape)
    whole = recorded(simulation, len(action))  # for all but the rows
    measured = replace(whole, observation=rows[:-1], action=action, following=rows[1:])
    found = headline_error(simulation, heavy, measured, headline_horizon(simulation, measured))
    assert found.name == "rail"
    assert found.after < 0.6 * found.before
