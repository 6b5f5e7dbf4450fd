"""Noise of the logged commands, which the simulator must not feel, because the machine has not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.measured.transitions import Measured

LAGS = 8  # rows before and after a command whose commands tell what it was
SHARES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4)  # tried sizes of the noise, in standard deviations of the commands


def expected_commands(measured: Measured) -> Iterator[Measured]:
    """The log with the commands that are expected for noise of several sizes, small ones first.

    With noise of variance s², the expectation of a command given the log is the logged one plus s² times the derivative
    of the log density of that value (Tweedie's formula; Efron, *Tweedie's formula and selection bias*, JASA 106, 2011).
    For normal densities, that derivative is -residual / variance of the residual, see :func:`unpredicted`. Noise larger
    than every residual is impossible.
    """
    residual = unpredicted(measured)
    limit, size = residual.var(0) + 1e-300, measured.action.std(0)
    for share in SHARES:
        factor = (share * size) ** 2 / limit
        if (factor >= 1.0).all():
            break
        yield replace(measured, action=measured.action - np.minimum(factor, 1.0) * residual)


def unpredicted(measured: Measured) -> np.ndarray:
    """The part of each command, (T, nu), that a linear regression on the rest of the log leaves.

    The rest are the same command in neighbouring rows, the other commands, and the readings of this row and the one
    before. Later readings are left out, because the simulator has to predict them.
    """
    rows = np.arange(len(measured))
    first, last = np.empty((2, len(rows)), int)
    for run in measured.runs:
        first[run], last[run] = run.start, run.stop - 1

    def shifted(values: np.ndarray, lag: int) -> np.ndarray:
        return values[np.clip(rows + lag, first, last)]

    logged = measured.action - measured.action.mean(0)
    readings = np.hstack([shifted(measured.observation, lag) for lag in (-1, 0)])
    found = np.empty_like(logged)
    for index, own in enumerate(logged.T):
        neighbours = [shifted(own, lag) for lag in range(-LAGS, LAGS + 1) if lag]
        known = np.column_stack([*neighbours, np.delete(logged, index, 1), readings - readings.mean(0)])
        found[:, index] = own - known @ np.linalg.lstsq(known, own, rcond=None)[0]
    return found
