"""States to start from, estimated from noisy sensors with the simulator itself: a Kalman filter over observations.

Noise levels come from the data. The filter looks back only, so that what is predicted from its states is a prediction;
the smoother also looks ahead and is for fits, never for a judgement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_h2o.residuals.measured.linearised import Linearised
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

_CLIP = 4.0  # robust standard deviations: a residual that is larger counts as this large for the sensors' noise
_SURPRISE = 4.0  # times what is expected of a squared innovation: from there on, the measurement is believed
_FLOOR = 1e-12  # of a dimension's variance


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """How much of the one-step residual is the sensors', and how much the simulator's.

    Args:
        sensor: (n), standard deviation of the noise of each sensor, in its unit.
        model: (n, n), covariance of what one step of the simulator misses, in units of the observations.
    """

    sensor: np.ndarray
    model: np.ndarray


@dataclass(frozen=True, eq=False)
class _Filtered:
    """A pass of the filter, all in spreads: means (T, n) and covariances (T, n, n), given and predicted."""

    mean: np.ndarray
    covariance: np.ndarray
    predicted_mean: np.ndarray
    predicted_covariance: np.ndarray


def estimate_states(simulation: Simulation, measured: Measured, noise: NoiseLevels | None = None) -> np.ndarray:
    """States to start from, each estimated from the rows up to and including its own.

    An extended Kalman filter, linearised about the measured rows; where a measurement surprises (a push), it is
    believed. Without sensor noise the measured states come out.

    Args:
        simulation: whose sensors, delays and hidden coordinates are respected.
        measured: the data.
        noise: levels, by default estimated from the rows that fits may see.

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
    linearised = Linearised.about(simulation, measured)
    noise = _noise_levels(linearised, measured) if noise is None else noise
    return linearised.states_at(_filter(linearised, noise).mean, simulation.state_map)


def smoothed_states(simulation: Simulation, measured: Measured, noise: NoiseLevels | None = None) -> np.ndarray:
    """States estimated from all rows of their run, the coming ones too (Rauch, Tung and Striebel).

    A prediction from them is none, as they know a little of what they predict. Arguments and result are those of
    :func:`estimate_states`.
    """
    linearised = Linearised.about(simulation, measured)
    noise = _noise_levels(linearised, measured) if noise is None else noise
    return linearised.states_at(_smooth(linearised, _filter(linearised, noise)), simulation.state_map)


def noise_levels(simulation: Simulation, measured: Measured) -> NoiseLevels:
    """The noise of sensors and simulator, from the residuals of one step from the measured states.

    Noise of a measured row enters the residual of the step to it and, with the other sign, that of the step from it.
    What the simulator misses does not, or with the same sign: so the product of successive residuals tells the sensors'
    share. Held-out rows are not looked at.
    """
    return _noise_levels(Linearised.about(simulation, measured), measured)


def _noise_levels(linearised: Linearised, measured: Measured) -> NoiseLevels:
    known, n = linearised.known & measured.usable & ~measured.held_out, linearised.observed.shape[1]
    rows = np.flatnonzero(known[:-1] & known[1:] & linearised.follows[:-1])
    residual = np.zeros_like(linearised.observed)
    residual[rows] = linearised.observed[rows + 1] - linearised.reached[rows]
    size = np.median(np.abs(residual[rows]), axis=0) / 0.6745 + np.sqrt(_FLOOR)
    clipped = np.clip(residual, -_CLIP * size, _CLIP * size)
    pairs = rows[:-1][np.diff(rows) == 1]
    sensor = _sensor_variance(clipped[pairs], clipped[pairs + 1], linearised.slope[pairs + 1], size)
    by_sensors = np.einsum("tij,j,tkj->ik", linearised.slope[rows], sensor, linearised.slope[rows]) / max(1, len(rows))
    # not clipped: who hits the floor hard is simulated badly just there, and the sensors are to be believed
    model = residual[rows].T @ residual[rows] / max(1, len(rows)) - np.diag(sensor) - by_sensors
    values, vectors = np.linalg.eigh(model / np.outer(size, size))
    model = (vectors * np.maximum(values, 1e-4)) @ vectors.T * np.outer(size, size)
    spread = linearised.spread
    return NoiseLevels(np.sqrt(sensor[:n]) * spread, model * np.outer(spread, spread))


def _sensor_variance(before: np.ndarray, after: np.ndarray, slope: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The variances, (n), that explain ``mean(after_i · before_j) = -slope_ij · variance_j`` best."""
    slope = slope * size / size[:, None]  # each residual in its own size
    product = (after / size)[:, :, None] * (before / size)[:, None, :]
    # a step that hits something has a slope of any size
    weight = 1.0 / (1.0 + (slope**2).sum(1, keepdims=True))
    share = -(weight * slope * product).sum((0, 1)) / np.maximum((weight * slope**2).sum((0, 1)), 1e-12)
    return np.maximum(share, 0.0) * size**2


def _filter(linearised: Linearised, noise: NoiseLevels) -> _Filtered:
    observed, known, n = linearised.observed, linearised.known, linearised.observed.shape[1]
    spread = linearised.spread
    sensor = np.diag((noise.sensor / spread) ** 2 + 1e-4 * _FLOOR)
    model = noise.model / np.outer(spread, spread) + _FLOOR * np.eye(n)
    mean, covariance = observed.copy(), np.tile(sensor, (len(observed), 1, 1))
    predicted_mean, predicted_covariance = mean.copy(), covariance.copy()
    for row in np.flatnonzero(linearised.follows):
        following = row + 1
        if not known[row]:
            continue  # the filter begins anew behind it
        slope = linearised.slope[row]
        guess = linearised.reached[row] + slope @ (mean[row] - observed[row])
        doubt = slope @ covariance[row] @ slope.T + model
        predicted_mean[following], predicted_covariance[following] = guess, doubt
        if known[following]:
            innovation = observed[following] - guess
            surprise = innovation @ np.linalg.solve(doubt + sensor, innovation) / n
            if surprise > _SURPRISE:
                doubt = doubt * surprise
            gain = np.linalg.solve(doubt + sensor, doubt).T
            mean[following] = guess + gain @ innovation
            left = gain @ sensor  # the same as doubt - gain @ doubt, without its cancellation
            covariance[following] = 0.5 * (left + left.T)
            predicted_covariance[following] = doubt
    return _Filtered(mean, covariance, predicted_mean, predicted_covariance)


def _smooth(linearised: Linearised, filtered: _Filtered) -> np.ndarray:
    mean, known = filtered.mean.copy(), linearised.known
    for row in np.flatnonzero(linearised.follows)[::-1]:
        if known[row] and known[row + 1]:
            carried = linearised.slope[row] @ filtered.covariance[row]
            back = np.linalg.solve(filtered.predicted_covariance[row + 1], carried).T
            mean[row] = filtered.mean[row] + back @ (mean[row + 1] - filtered.predicted_mean[row + 1])
    return mean
