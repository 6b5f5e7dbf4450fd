"""What sensor noise alone would make of a fit: data as they would be if nothing were missing but noise.

States read from noisy sensors bias every fit: noise looks like damping, and contacts, which answer it one way only,
like a force. So an explanation has to do better on the data than on such stand-ins for them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.measured.initial_states import noise_levels
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.simulation.simulation import Simulation

ENOUGH = 2000  # transitions, to estimate noise from
NOISELESS = 1e-4  # of a dimension's spread: less noise biases nothing that could be seen


def sensor_noise(simulation: Simulation, measured: Measured) -> np.ndarray | None:
    """The standard deviations of the sensors' noise, (n), in their units; None where it could bias nothing."""
    std = noise_levels(simulation, measured.part(slice(0, ENOUGH))).sensor
    return std if (std > NOISELESS * measured.observation.std(0)).any() else None


def stand_in(
    simulation: Simulation,
    measured: Measured,
    sensor_std: np.ndarray,
    rng: np.random.Generator,
    horizon: int = 1,
    states: np.ndarray | None = None,
) -> Measured:
    """Data in which nothing is missing from a simulation: its own windows, read by noisy sensors.

    Args:
        simulation: with the effects found so far.
        measured: where windows start, and what is done in them.
        sensor_std: (n), noise of each reading, in its unit.
        rng: draws the noise.
        horizon: control steps of the windows.
        states: (T, nq + nv), that windows start from, instead of the measured ones.

    Returns:
        The data, right in windows of this horizon that do not overlap.
    """
    if states is None:
        states = start_states(simulation, measured)
    following = measured.following.copy()
    actions = executed_actions(simulation, measured)
    for starts in (measured.fitted(horizon), measured.judged(horizon)):
        rows = starts[:, None] + np.arange(horizon)
        reached = simulation.rollout(states[starts], actions[rows], time=measured.time[starts])
        following[rows] = simulation.state_map.observations(reached)
    noise = rng.standard_normal((2, *following.shape)) * sensor_std
    true = simulation.state_map.observations(states)
    return replace(measured, observation=true + noise[0], following=following + noise[1])
