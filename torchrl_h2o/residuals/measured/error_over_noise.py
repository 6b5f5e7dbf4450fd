"""The error of a simulation at the end of windows, and the error that sensor noise alone causes there."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation


def errors_and_noise(
    simulation: Simulation,
    measured: Measured,
    starts: np.ndarray,
    horizon: int,
    sensor_std: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors at the end of windows, and those that a draw of sensor noise causes in the same windows.

    The noise disturbs the state that a window starts from, and the reading at its end. Action noise that the simulator
    has is drawn too.

    Args:
        simulation: the simulator.
        measured: the data.
        starts: (W), first row of each window.
        horizon: control steps per window.
        sensor_std: (n), standard deviation of the readings' noise, in their units.
        rng: generator of the noise.

    Returns:
        Two arrays (V, n), in the units of the observations, of the windows in which no simulation diverges.
    """
    states = start_states(simulation, measured, starts)
    noise = sensor_std * rng.standard_normal((2, *measured.observation.shape))
    disturbed = states + noise[0] @ simulation.state_map.restore_observed.T
    error = residuals(simulation, measured, starts, horizon, states=states)[:, -1]
    with_noise = residuals(simulation, measured, starts, horizon, states=disturbed, rng=rng)[:, -1]
    by_noise = with_noise - error + noise[1][starts + horizon - 1]
    whole = np.isfinite(error).all(1) & np.isfinite(by_noise).all(1)
    return np.abs(error[whole]), np.abs(by_noise[whole])


def error_over_noise(
    simulation: Simulation,
    measured: Measured,
    starts: np.ndarray,
    horizon: int,
    sensor_std: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Median error at the end of windows over the median error that sensor noise alone causes, (n).

    About 1 where the simulator's error is smaller than the noise; 0 where all windows diverge. The arguments are those
    of :func:`errors_and_noise`.
    """
    error, by_noise = errors_and_noise(simulation, measured, starts, horizon, sensor_std, rng)
    if not len(error):
        return np.zeros(len(sensor_std))
    rounding = 1e-9 * measured.observation.std(0) + 1e-300
    return np.median(error, axis=0) / np.maximum(np.median(by_noise, axis=0), rounding)
