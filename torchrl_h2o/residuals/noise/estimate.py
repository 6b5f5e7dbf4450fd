"""Estimates the noise of the executed action from the covariance of one-step residuals.

Such noise leaves the mean residual unchanged, so a fit of effects cannot find it. It scatters residuals along the
actuators' directions, whereas sensor noise scatters them along the directions of the start state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_h2o.residuals.measured.sensor_noise import sensor_std, stand_in
from torchrl_h2o.residuals.measured.significance import p_value
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.noise.scatter import Scatter
from torchrl_h2o.residuals.noise.variances import BLOCKS, fitted_variances, log_likelihood
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation

MIN_SHARE = 1e-3  # smallest reported standard deviation, as a share of the control range
# largest plausible standard deviation, in RMS of the actions; larger estimates come from filtered sensors
MAX_SHARE = 2.0
# number of half-widths that the estimate must exceed, because the interval omits errors that blocks share
MIN_HALF_WIDTHS = 3.0
BEYOND_SENSORS = 3.0  # required multiple of the estimate from synthetic data with sensor noise only


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """Estimated noise of the executed action.

    Args:
        action_std: standard deviation of the executed action about the commanded one, in units of the action, the same
            for all actuators.
        half_width: half-width of its 95 % interval.
        p_value: p-value of the gain in held-out likelihood; 1 if the estimate is implausible.
    """

    action_std: float
    half_width: float
    p_value: float


def estimate_noise(simulation: Simulation, measured: Measured, settings: LoopSettings = DEFAULTS) -> NoiseEstimate:
    r"""Separates the noise of the executed action from sensor noise by the covariance of one-step residuals.

    With the simulator's derivatives :math:`F` by the observation and :math:`G` by the action, a residual is
    :math:`e = n' - F n + G\nu` with covariance
    :math:`\Sigma + F\Sigma F^\top + G\,\mathrm{E}[\nu\nu^\top] G^\top`. The variances are fitted to the squared
    residuals and judged by the held-out likelihood with and without :math:`\nu`. MuJoCo clamps the control near its
    limits and with it the noise; :math:`\mathrm{E}[\nu\nu^\top]` is the second moment after clamping.

    Args:
        simulation: the simulator with all effects found so far, and without its own action noise.
        measured: the data.
        settings: thresholds and numerics.

    Returns:
        The estimate.
    """
    fitted = Scatter.of(simulation, measured, measured.fitted())
    judged = Scatter.of(simulation, measured, measured.selected_on(), fitted.scale)
    # noise with opposite signs in successive residuals is attributed to the sensors, even if action noise could fit it
    by_sensors = sensor_std(simulation, measured)
    estimate, left_out = fitted_variances(fitted, by_sensors)
    silent, _ = fitted_variances(fitted.without_action(), by_sensors)
    std = float(np.sqrt(estimate[0]))
    half_width = float(1.96 * np.sqrt(BLOCKS - 1) * np.std(np.sqrt(left_out)))
    if not _plausible(simulation, measured, std, half_width):
        return NoiseEstimate(std, half_width, 1.0)
    sensors_alone = stand_in(simulation, measured, by_sensors, np.random.default_rng(0))
    scatter_alone = Scatter.of(simulation, sensors_alone, measured.fitted())
    alone, _ = fitted_variances(scatter_alone, by_sensors)
    if std < BEYOND_SENSORS * np.sqrt(alone[0]):
        return NoiseEstimate(std, half_width, 1.0)
    gain = log_likelihood(estimate, judged) - log_likelihood(silent, judged.without_action())
    return NoiseEstimate(std, half_width, p_value(gain, settings))


def _plausible(simulation: Simulation, measured: Measured, std: float, half_width: float) -> bool:
    """Whether an estimate exceeds its uncertainty and a minimum, and is not larger than the actions."""
    low, high = simulation.model.actuator_ctrlrange.T
    reach = np.where(high > low, high - low, 2.0 * np.abs(measured.action).max(0) + 1e-12).mean()
    asked = float(np.sqrt((measured.action**2).mean()))
    least = max(MIN_SHARE * reach, MIN_HALF_WIDTHS * half_width)
    return bool(least < std < MAX_SHARE * asked)
