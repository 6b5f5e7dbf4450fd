"""Estimate a velocity from a measured position by local polynomials, with the size of its error.

A cubic is fitted to a window around each row, which is the smoother of Savitzky and Golay (1964), Analytical Chemistry
36, 1627. A short window passes on the noise of the position, a long one cuts off fast motion; the window is chosen
such that the sum of both squared errors is smallest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_HALF_WIDTHS = (3, 4, 5, 6, 8, 10, 12, 15, 18, 22, 27, 33, 40, 50, 60, 75, 90)  # rows; odd windows of 7 to 181
_DIFFERENCES = (3, 4, 5, 6)  # orders of the differences that show noise
_CERTAIN = 4.0  # standard deviations of the mean square of noise beyond which a difference counts as motion
_SHORTEST_RUN = 2 * _HALF_WIDTHS[0] + 2


@dataclass(frozen=True)
class VelocityEstimate:
    """A velocity that was estimated from a position.

    Args:
        velocity: in units of the position per s, (rows,); NaN in rows too close to the ends of their run.
        std: standard deviation of its error, in the same unit: noise of the position and motion that is too fast for
            the window. The errors of rows within a window are correlated.
        window: length of the window in rows.
        position_std: standard deviation of the position's noise, in its unit.
    """

    velocity: np.ndarray
    std: float
    window: int
    position_std: float


def estimate_velocity(
    position: np.ndarray, runs: Sequence[slice], dt: float, *, angle: bool = False, least_noise: float = 0.0
) -> VelocityEstimate:
    """Estimate the derivative of a position at each row, and the error of the estimate.

    Args:
        position: positions at equal time steps, (rows,).
        runs: the rows of each unbroken run; windows do not reach across their ends.
        dt: time between two rows in s.
        angle: whether the positions are in rad and may jump by 2π.
        least_noise: standard deviation that the positions' noise has at least, in their unit.

    Returns:
        The estimate. Rows within half a window of the ends of their run have none.

    Raises:
        ValueError: if no run has 8 rows.

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data.readers.velocity import estimate_velocity
        >>> time = 0.01 * np.arange(500)
        >>> noise = np.random.default_rng(0).normal(0.0, 1e-3, 500)
        >>> found = estimate_velocity(np.sin(3 * time) + noise, [slice(0, 500)], 0.01)
        >>> error = np.nanstd(found.velocity - 3 * np.cos(3 * time))
        >>> bool(0.7 < found.std / error < 1.4)
        True
    """
    parts = [np.unwrap(position[run]) if angle else position[run] for run in runs]
    longest = max((len(part) for part in parts), default=0)
    if longest < _SHORTEST_RUN:
        raise ValueError(f"the longest run has {longest} rows, but a velocity is estimated from {_SHORTEST_RUN}")
    # windows of at most a quarter of the longest run, because half of one is lost at each end
    widths = [width for width in _HALF_WIDTHS if 8 * width <= longest] or [_HALF_WIDTHS[0]]
    noise = max(least_noise, _noise(parts, widths))
    std, width = min((_error(parts, width, noise, dt), width) for width in widths)
    velocity = np.full(len(position), np.nan)
    kernel = _kernels(width, 3)[1] / dt
    for run, part in zip(runs, parts, strict=True):
        inside = np.arange(len(position))[run][width : len(part) - width]
        if len(inside):
            velocity[inside] = np.correlate(part, kernel, "valid")
    return VelocityEstimate(velocity, std, 2 * width + 1, noise)


def _noise(parts: Sequence[np.ndarray], widths: Sequence[int]) -> float:
    """Standard deviation of white noise in the positions.

    It is the scatter about the cubic with the smallest error of leave-one-out prediction, or the noise in differences
    of high order if that is smaller: a cubic takes a vibration for noise. Positions that are rounded have at least the
    noise of rounding, the step divided by √12, also while they rest.
    """
    best, variance = math.inf, 0.0
    for width in widths:
        smooth = _kernels(width, 3)[0]
        squares = [(part[width:-width] - np.correlate(part, smooth, "valid")) ** 2 for part in _long(parts, width)]
        scatter, own = float(np.mean(np.concatenate(squares))), smooth[width]
        if (left_out := scatter / (1.0 - own) ** 2) < best:
            best, variance = left_out, scatter / (1.0 - 2.0 * own + float(smooth @ smooth))
    for order in _DIFFERENCES:
        squares = np.concatenate([np.diff(part, order) ** 2 for part in parts])
        variance = min(variance, float(squares.mean()) / math.comb(2 * order, order))
    steps = np.abs(np.concatenate([np.diff(part) for part in parts]))
    # steps below a millionth of the largest are rounding of the numbers, not of the sensor
    moved = steps[steps > 1e-6 * steps.max()] if len(steps) and steps.max() > 0 else np.zeros(1)
    return math.sqrt(max(variance, float(moved.min()) ** 2 / 12.0 if _is_rounded(moved) else 0.0))


def _is_rounded(moved: np.ndarray) -> bool:
    """Whether all steps are multiples of the smallest one."""
    least = moved.min()
    if least == 0.0:
        return False
    multiples = moved / least
    return bool(np.abs(multiples - np.round(multiples)).max() < 0.05) and len(moved) > 10 and multiples.max() < 1e4


def _error(parts: Sequence[np.ndarray], width: int, noise: float, dt: float) -> float:
    """Standard deviation of the velocity's error with a window.

    What the window cuts off is estimated by the difference to a polynomial of the fifth degree, in the same window and
    in the shortest one, less the noise of that difference.
    """
    cubic = _kernels(width, 3)[1]
    cut = 0.0
    for other, certain in ((width, 0.0), (_HALF_WIDTHS[0], _CERTAIN)):
        fifth = np.pad(_kernels(other, 5)[1], width - other)
        squares = np.concatenate([np.correlate(part, fifth - cubic, "valid") ** 2 for part in _long(parts, width)])
        own = noise**2 * float((fifth - cubic) @ (fifth - cubic))
        # neighbouring windows overlap, so the mean has as many independent terms as there are windows side by side
        chance = math.sqrt(2.0 * (2 * other + 1) / len(squares))
        if (more := float(squares.mean()) - own) > certain * chance * own:
            cut = max(cut, more)
    return math.sqrt(noise**2 * float(cubic @ cubic) + cut) / dt


def _long(parts: Sequence[np.ndarray], width: int) -> list[np.ndarray]:
    return [part for part in parts if len(part) > 2 * width]


def _kernels(width: int, degree: int) -> np.ndarray:
    """Weights of the value and of the slope per row, (2, 2 · width + 1), at the middle of a fitted polynomial."""
    rows = np.arange(-width, width + 1) / width
    kernels = np.linalg.pinv(np.vander(rows, degree + 1, increasing=True))[:2]
    kernels[1] /= width
    return kernels
