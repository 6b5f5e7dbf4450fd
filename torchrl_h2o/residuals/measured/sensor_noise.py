"""Sensor noise of measured data, and synthetic data in which this noise is the only difference from a simulator.

Start states read from noisy sensors bias every fit: noise imitates damping, and contacts, which push in one direction
only, turn zero-mean noise into a mean force. An explanation must therefore reduce the loss more on the measured data
than on such synthetic data.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.measured.initial_states import noise_levels
from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

NOISE_ROWS = 2000  # transitions from which the sensors' noise is estimated
# sensor noise, in spreads, up to which a dimension counts as free of noise; the bias of a fit is negligible
NOISELESS = 1e-4


def sensor_noise(simulation: Simulation, measured: Measured) -> np.ndarray | None:
    """Standard deviation of each sensor's noise, (n), in its unit; None if all of them are negligible."""
    std = sensor_std(simulation, measured)
    return std if (std > NOISELESS * measured.observation.std(0)).any() else None


def sensor_std(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Standard deviation of each sensor's noise, (n), in its unit, estimated from the first rows of the data.

    It is not less than the known error of columns that were estimated from others. Such errors are alike in successive
    rows, so the residuals alone would show too little of them.
    """
    first = slice(0, NOISE_ROWS)
    std = measured.remembered(
        "noise of the sensors", simulation, lambda: noise_levels(simulation, measured.part(first)).sensor
    )
    return std if measured.estimated_std is None else np.maximum(std, measured.estimated_std)


def stand_in(
    simulation: Simulation,
    measured: Measured,
    sensor_std: np.ndarray,
    rng: np.random.Generator,
    horizon: int = 1,
    states: np.ndarray | None = None,
) -> Measured:
    """Simulates the measured windows and adds sensor noise to the observations.

    Args:
        simulation: the simulator with the effects found so far.
        measured: source of the windows' start states and actions.
        sensor_std: (n), standard deviation of each reading's noise, in its unit.
        rng: generator of the noise.
        horizon: control steps per window.
        states: (T, nq + nv), start states of the windows; the measured ones by default.

    Returns:
        The data; they are consistent within non-overlapping windows of this horizon.
    """
    if states is None:
        states = start_states(simulation, measured)
    following = measured.following.copy()
    actions = executed_actions(simulation, measured)
    before = activations(simulation, measured, actions)
    for starts in (measured.fitted(horizon), measured.selected_on(horizon)):
        rows = starts[:, None] + np.arange(horizon)
        reached = simulation.rollout(
            states[starts], actions[rows], time=measured.time[starts], activations=before[starts]
        )
        following[rows] = simulation.state_map.observations(reached)
    noise = rng.standard_normal((2, *following.shape)) * sensor_std
    true = simulation.state_map.observations(states)
    return replace(measured, observation=true + noise[0], following=following + noise[1])
