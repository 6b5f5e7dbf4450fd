"""The windows of a log in which something moves: a simulator has nothing to predict in the others."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.moving_rows import moving_rows
from torchrl_h2o.residuals.measured.transitions import Measured


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
    rows = measured.remembered("rows in motion", None, lambda: moving_rows(measured.observation, measured.run))
    passed = np.concatenate([[0], np.cumsum(rows)])
    moves = passed[starts + steps] > passed[starts]
    return starts[moves] if moves.sum() >= least else starts
