"""The windows of a log in which something moves: a simulator has nothing to predict in the others."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.derivative import deviation
from torchrl_h2o.residuals.measured.transitions import Measured

_THIRD_DIFFERENCES = np.sqrt(20.0)  # standard deviation of the third differences of white noise with deviation 1


def in_motion(measured: Measured, starts: np.ndarray, steps: int, least: int) -> np.ndarray:
    """The windows in which a reading changes by more than its noise.

    A log may rest for most of its time, as a pendulum does that has swung out. Medians over all of its windows would be
    those of a resting robot, whose motion is predicted without error by any simulator with friction.

    Args:
        measured: the data.
        starts: (W), first row of each window.
        steps: control steps per window.
        least: smallest number of windows to return; if fewer move, all are returned.

    Returns:
        (V), first rows of these windows.
    """
    if not len(starts):
        return starts
    rows = starts[:, None] + np.arange(steps)
    values = np.concatenate([measured.observation[rows], measured.following[rows[:, -1:]]], axis=1)
    moves = (values.std(1) > _spread_at_rest(measured)).any(1)
    return starts[moves] if moves.sum() >= least else starts


def _spread_at_rest(measured: Measured) -> np.ndarray:
    """Standard deviation of each reading within a window, (n), up to which it may stand still."""
    settings, spread = measured.settings, measured.observation.std(0)
    unbroken = measured.run[3:] == measured.run[:-3]
    rough = np.diff(measured.observation, 3, axis=0)[unbroken]
    noise = np.array([deviation(column) for column in rough.T]) / _THIRD_DIFFERENCES if len(rough) else 0.0 * spread
    return np.clip(settings.rest * noise, settings.least_rest * spread, settings.most_rest * spread)
