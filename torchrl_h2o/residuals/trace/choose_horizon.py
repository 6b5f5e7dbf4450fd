"""Chooses the window length of the search: the shortest at which the simulator's error exceeds the sensors' noise."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise
from torchrl_h2o.residuals.measured.transitions import Measured, thinned
from torchrl_h2o.residuals.settings import DEFAULTS, HorizonSettings, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


def choose_horizon(
    simulation: Simulation,
    measured: Measured,
    rng: np.random.Generator,
    settings: LoopSettings = DEFAULTS,
) -> int:
    """Chooses how many control steps each window of the search has.

    With good sensors one step is enough. With noisy sensors a longer window helps: the error from a missing effect
    accumulates over the window, but the noise of the start state does so less. A slow effect, such as a loss of energy
    over minutes, shows only in long windows.

    Args:
        simulation: the simulator.
        measured: the data.
        rng: generator of synthetic noise.
        settings: lengths to choose from, and thresholds.

    Returns:
        Control steps per window.
    """
    sensor_std = sensor_noise(simulation, measured)
    if sensor_std is None:
        return 1
    rules = settings.horizon
    best, most = 1, 0.0
    for horizon in possible_horizons(simulation, measured, rules):
        ratio = float(error_over_noise(simulation, measured, horizon, sensor_std, rng, rules).max())
        if ratio > rules.longer_gain * most:
            best, most = horizon, ratio
        if ratio > rules.stands_out:
            break
    return best


def possible_horizons(simulation: Simulation, measured: Measured, rules: HorizonSettings) -> list[int]:
    """One control step and the lengths of the settings, in control steps, of which the data hold enough windows."""
    steps = sorted({1, *(round(seconds / simulation.control_step) for seconds in rules.seconds)} - {0})
    return [horizon for horizon in steps if horizon == 1 or _enough_windows(measured, horizon, rules)]


def _enough_windows(measured: Measured, horizon: int, rules: HorizonSettings) -> bool:
    fitted, selected_on = measured.fitted(horizon), measured.selected_on(horizon)
    return len(fitted) >= rules.min_fitted and len(selected_on) >= rules.min_selected


def error_over_noise(
    simulation: Simulation,
    measured: Measured,
    horizon: int,
    sensor_std: np.ndarray,
    rng: np.random.Generator,
    rules: HorizonSettings = DEFAULTS.horizon,
) -> np.ndarray:
    """Median error at the end of windows over the median error that sensor noise alone causes.

    Args:
        simulation: the simulator.
        measured: the data; only the part for fits is used.
        horizon: control steps per window.
        sensor_std: (n), standard deviation of the readings' noise, in their units.
        rng: generator of synthetic noise.
        rules: number of windows.

    Returns:
        (n); about 1 where the simulator's error is smaller than the noise, 0 where all windows diverge.
    """
    starts = thinned(measured.fitted(horizon), rules.windows)
    states = start_states(simulation, measured, starts)
    noise = sensor_std * rng.standard_normal((2, *measured.observation.shape))
    disturbed = states + noise[0] @ simulation.state_map.restore.T
    error, with_noise = (
        residuals(simulation, measured, starts, horizon, states=each)[:, -1] for each in (states, disturbed)
    )
    by_noise = with_noise - error + noise[1][starts]
    whole = np.isfinite(error).all(1) & np.isfinite(by_noise).all(1)
    if not whole.any():
        return np.zeros(len(sensor_std))
    size = np.maximum(np.median(np.abs(by_noise[whole]), axis=0), 1e-9 * measured.observation.std(0) + 1e-300)
    return np.median(np.abs(error[whole]), axis=0) / size
