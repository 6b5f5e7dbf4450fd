"""Fits of a position's displacement against the integral of its velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.data.audit.log import Log, Pair

SPAN = 0.3  # displacement, in standard deviations, over which slopes are fitted; longer windows average noise
LONGEST_SPAN = 64  # rows of the longest such window
RELATED = 0.7  # correlation of displacement and integral below which the columns do not belong together
VELOCITY_LAGS = (-3, 24)  # rows by which a velocity may be early or late
LAG_GAIN = 0.7  # share of the unexplained variance that a shifted velocity must leave at most
SCALE_WARNING = (0.85, 1.18)  # factors between derivative and velocity that are unsuspicious
SCALE_SEVERE = (0.6, 1.67)  # factors between which a wrong scale is only a warning
FARTHEST = 2.0  # multiple of the distance at the largest measured velocity beyond which no joint moves in one step
KNOWN_FACTOR = 0.15  # relative distance to a known factor, such as 57.3 deg/rad, at which it is named


@dataclass(frozen=True)
class Derivative:
    """How a position's derivative depends on the velocity column: derivative = factor · velocity + bias.

    Args:
        pair: the columns.
        factor: slope; 1 if the velocity is the derivative of the position.
        bias: in units of the position per second.
        correlation: of displacement and integral, over windows that average noise.
        lag: rows by which the velocity is late; 0 if no shift fits better.
        position_noise: upper estimate of the noise of the position, in its unit.
        velocity_noise: upper estimate of the noise of the velocity, in its unit.
    """

    pair: Pair
    factor: float
    bias: float
    correlation: float
    lag: float
    position_noise: float
    velocity_noise: float


def fit_derivative(log: Log, pair: Pair) -> Derivative:
    """Fits one pair of columns; jumps are left out."""
    displacement, integral, good = steps_of(log, pair.position, pair.velocity)
    factor, bias, correlation = related(log, displacement, integral, good)
    lag = _lateness(log, displacement, integral, good)
    error = (displacement - (factor if correlation > RELATED else 1.0) * integral)[good]
    usual = deviation(error)
    spread = log.observation[:, pair.velocity].std()
    return Derivative(
        pair,
        factor,
        bias / log.dt,
        correlation,
        lag,
        min(usual / np.sqrt(2.0), roughness(log, pair.position)),
        min(usual * np.sqrt(2.0) / log.dt, roughness(log, pair.velocity), spread),
    )


def lateness(derivatives: Sequence[Derivative]) -> float:
    """Rows by which the velocities are late against their positions, the median over the pairs; at least 0."""
    return max(0.0, float(np.median([derivative.lag for derivative in derivatives]))) if derivatives else 0.0


def steps_of(log: Log, position: int, velocity: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement of one column per row and integral of another, (T,), and rows without jumps or clipping, (T,)."""
    displacement = log.following[:, position] - log.observation[:, position]
    integral = 0.5 * log.dt * (log.following[:, velocity] + log.observation[:, velocity])
    large = 5.0 * np.quantile(np.abs(displacement), 0.95)
    return displacement, integral, (np.abs(displacement) <= large) & ~log.clipped


def related(log: Log, displacement: np.ndarray, integral: np.ndarray, good: np.ndarray) -> tuple[float, float, float]:
    """Slope, intercept per row and correlation over the shortest windows in which the displacement is large."""
    horizon, found = 1, (np.nan, 0.0, 0.0)
    spread = float(np.std(np.cumsum(np.where(good, displacement, 0.0))))
    while True:
        x, y = (windowed(log, values, good, horizon) for values in (integral, displacement))
        if len(x) < 20:
            return found
        found = _line(x, y, horizon)
        if np.std(y) >= SPAN * spread or horizon >= LONGEST_SPAN:
            return found
        horizon *= 2


def _line(x: np.ndarray, y: np.ndarray, horizon: int) -> tuple[float, float, float]:
    dx, dy = x - x.mean(), y - y.mean()
    size = np.sqrt((dx**2).sum() * (dy**2).sum())
    if size == 0.0:
        return np.nan, 0.0, 0.0
    slope = float((dx * dy).sum() / (dx**2).sum())
    return slope, float(y.mean() - slope * x.mean()) / horizon, float((dx * dy).sum() / size)


def windowed(log: Log, values: np.ndarray, good: np.ndarray, horizon: int) -> np.ndarray:
    """Sums over windows of one run without excluded rows, overlapping by half, (W,)."""
    starts = np.arange(0, len(values) - horizon + 1, max(1, horizon // 2))
    bad = np.concatenate([[0], np.cumsum(~good)])
    whole = (bad[starts + horizon] == bad[starts]) & (log.run[starts] == log.run[starts + horizon - 1])
    total = np.concatenate([[0.0], np.cumsum(values)])
    return (total[starts + horizon] - total[starts])[whole]


def _lateness(log: Log, displacement: np.ndarray, integral: np.ndarray, good: np.ndarray) -> float:
    """Shift in rows at which displacement and velocity correlate best; 0 unless it leaves much less unexplained."""
    first, last = VELOCITY_LAGS
    lags = np.arange(first, last + 1)
    found = np.zeros(len(lags))
    for index, lag in enumerate(lags):
        rows = np.arange(max(0, -lag), len(log) - max(0, lag))
        rows = rows[good[rows] & good[rows + lag] & (log.run[rows] == log.run[rows + lag])]
        if len(rows) > 50 and np.std(integral[rows + lag]) > 0.0 and np.std(displacement[rows]) > 0.0:
            found[index] = abs(np.corrcoef(displacement[rows], integral[rows + lag])[0, 1])
    best = int(found.argmax())
    if 1.0 - found[best] ** 2 > LAG_GAIN * (1.0 - found[-first] ** 2):
        return 0.0
    if 0 < best < len(lags) - 1:  # vertex of the parabola through three points
        left, middle, right = found[best - 1 : best + 2]
        return float(lags[best] + 0.5 * (left - right) / min(left - 2.0 * middle + right, -1e-12))
    return float(lags[best])


def farthest(log: Log, pair: Pair) -> float:
    """Distance beyond which no joint moves in one step, by its largest measured velocity."""
    return FARTHEST * log.dt * float(np.abs(log.observation[:, pair.velocity]).max())


def roughness(log: Log, column: int) -> float:
    """Noise of a column from its third differences: an upper estimate, because fast motion adds to it."""
    return roughness_of(log.observation[:, column], log.run)


def roughness_of(values: np.ndarray, run: np.ndarray) -> float:
    """:func:`roughness` of values (T,) in runs (T,)."""
    third = np.diff(values, 3)[run[3:] == run[:-3]]
    return float(deviation(third) / np.sqrt(20.0)) if len(third) > 20 else float(np.std(values))


def deviation(values: np.ndarray) -> float:
    """Robust standard deviation from the median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0
