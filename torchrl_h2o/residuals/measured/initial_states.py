"""Start states estimated from noisy sensors: an extended Kalman filter over the simulator.

Noise levels are estimated from the data. The filter uses past rows only, so a prediction may start from its states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_lapack_funcs

from torchrl_h2o.residuals.measured.linearised import Linearised
from torchrl_h2o.residuals.measured.residual import executed_actions
from torchrl_h2o.residuals.measured.settling import settle
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.simulation.simulation import Simulation

NOISE_CLIP = 4.0  # robust standard deviations at which residuals are clipped before the sensors' noise is estimated
FILTER_SURPRISE = 4.0  # normalised squared innovation beyond which the Kalman filter follows the measurement
VARIANCE_FLOOR = 1e-12  # smallest variance in the filter, in squared spreads

(_posv,) = get_lapack_funcs(("posv",), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Contributions of sensor noise and simulator error to the one-step residual.

    Args:
        sensor: (n), standard deviation of each sensor's noise, in its unit.
        model: (n, n), covariance of the simulator's one-step error, in units of the observations.
    """

    sensor: np.ndarray
    model: np.ndarray


def estimate_states(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Estimates the state of each row from the rows up to and including it.

    Uses an extended Kalman filter, linearised about the measured rows. Where the innovation is far larger than expected
    (a push), the filter follows the measurement. Without sensor noise the result equals the measured states. Noise
    levels are estimated from the rows that are not held out.

    Args:
        simulation: simulator with its sensors, delays and unobserved coordinates.
        measured: the data.

    Returns:
        (T, nq + nv).

    Examples:
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> from torchrl_h2o.residuals import Measured, Simulation
        >>> data = record(WheelLeggedEnv(), noisy_balance_controller(), 300, seed=0)
        >>> simulation = Simulation.from_env(WheelLeggedEnv())
        >>> estimate_states(simulation, Measured.from_ted(data, simulation)).shape
        (300, 8)
    """

    def compute() -> np.ndarray:
        linearised = Linearised.about(simulation, measured)
        mean = _filter(linearised, _noise_levels(linearised, measured))
        states = linearised.states_at(mean, simulation.state_map)
        return settle(simulation, measured, states, executed_actions(simulation, measured), np.arange(len(measured)))

    return measured.remembered("states", simulation, compute)


def noise_levels(simulation: Simulation, measured: Measured) -> NoiseLevels:
    """Estimates the noise of sensors and simulator from one-step residuals at the measured states.

    Sensor noise of a row enters two successive residuals with opposite signs: the step that ends at this row and the
    step that starts there. An error of the simulator enters one residual only, or successive ones with the same sign.
    The product of successive residuals therefore gives the variance of the sensor noise. Held-out rows are not used.
    """
    return _noise_levels(Linearised.about(simulation, measured), measured)


def _noise_levels(linearised: Linearised, measured: Measured) -> NoiseLevels:
    known, n = linearised.known & measured.usable & (measured.split == Split.FIT), linearised.observed.shape[1]
    rows = np.flatnonzero(known[:-1] & known[1:] & linearised.follows[:-1])
    residual = np.zeros_like(linearised.observed)
    residual[rows] = linearised.observed[rows + 1] - linearised.reached[rows]
    size = np.median(np.abs(residual[rows]), axis=0) / 0.6745 + np.sqrt(VARIANCE_FLOOR)
    clipped = np.clip(residual, -NOISE_CLIP * size, NOISE_CLIP * size)
    pairs = rows[:-1][np.diff(rows) == 1]
    sensor = _sensor_variance(clipped[pairs], clipped[pairs + 1], linearised.slope[pairs + 1], size)
    by_sensors = np.einsum("tij,j,tkj->ik", linearised.slope[rows], sensor, linearised.slope[rows]) / max(1, len(rows))
    # not clipped: at a hard contact the simulator is wrong, and the filter should follow the sensors there
    model = residual[rows].T @ residual[rows] / max(1, len(rows)) - np.diag(sensor) - by_sensors
    values, vectors = np.linalg.eigh(model / np.outer(size, size))
    model = (vectors * np.maximum(values, 1e-4)) @ vectors.T * np.outer(size, size)
    spread = linearised.spread
    return NoiseLevels(np.sqrt(sensor[:n]) * spread, model * np.outer(spread, spread))


def _sensor_variance(before: np.ndarray, after: np.ndarray, slope: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Least-squares variances, (n), of ``mean(after_i · before_j) = -slope_ij · variance_j``."""
    slope = slope * size / size[:, None]  # residuals in units of their own size
    product = (after / size)[:, :, None] * (before / size)[:, None, :]
    # at a contact the derivative may be arbitrarily large
    weight = 1.0 / (1.0 + (slope**2).sum(1, keepdims=True))
    share = -(weight * slope * product).sum((0, 1)) / np.maximum((weight * slope**2).sum((0, 1)), 1e-12)
    return np.maximum(share, 0.0) * size**2


def _filter(linearised: Linearised, noise: NoiseLevels) -> np.ndarray:
    """Filtered observations, (T, n), in spreads."""
    observed, known, n = linearised.observed, linearised.known, linearised.observed.shape[1]
    spread = linearised.spread
    sensor = np.diag((noise.sensor / spread) ** 2 + 1e-4 * VARIANCE_FLOOR)
    model = noise.model / np.outer(spread, spread) + VARIANCE_FLOOR * np.eye(n)
    mean, covariance = observed.copy(), np.tile(sensor, (len(observed), 1, 1))
    for row in np.flatnonzero(linearised.follows):
        following = row + 1
        if not known[row]:
            continue  # the filter restarts at the next known row
        slope = linearised.slope[row]
        guess = linearised.reached[row] + slope @ (mean[row] - observed[row])
        doubt = slope @ covariance[row] @ slope.T + model
        if known[following]:
            innovation = observed[following] - guess
            surprise = innovation @ _solve(doubt + sensor, innovation) / n
            if surprise > FILTER_SURPRISE:
                doubt = doubt * surprise
            gain = _solve(doubt + sensor, doubt).T
            mean[following] = guess + gain @ innovation
            left = gain @ sensor  # equals doubt - gain @ doubt, without cancellation
            covariance[following] = 0.5 * (left + left.T)
    return mean


def _solve(covariance: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solves for a symmetric matrix by Cholesky's method.

    A call of LAPACK for up to six observations takes a quarter of the time of NumPy's.
    """
    _, solution, failed = _posv(covariance, right)
    return np.linalg.solve(covariance, right) if failed else solution  # rounding may leave it not positive definite
