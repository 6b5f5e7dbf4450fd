"""The rows of a log in which something moves."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.derivative import roughness_of
from torchrl_h2o.residuals.settings import DEFAULTS, MeasuredSettings


def moving_rows(observation: np.ndarray, run: np.ndarray, settings: MeasuredSettings = DEFAULTS.measured) -> np.ndarray:
    """The rows about which a reading changes by more than its noise, mask (T,).

    Each row is judged by the standard deviation of the readings in the rows about it, within its run.

    Args:
        observation: (T, n), readings.
        run: (T), index of each row's run, ascending.
        settings: number of rows, and the standard deviation up to which a reading stands still.

    Examples:
        >>> readings = np.concatenate([np.zeros((40, 1)), np.sin(np.arange(60.0))[:, None]])
        >>> moves = moving_rows(readings, np.zeros(100, int))
        >>> bool(moves[:30].any()), bool(moves[50:].all())
        (False, True)
    """
    limit, about = _spread_at_rest(observation, run, settings), settings.rest_rows
    moves, edges = np.zeros(len(run), bool), np.flatnonzero(np.diff(run)) + 1
    centred = observation - observation.mean(0)
    for rows in np.split(np.arange(len(run)), edges):
        values, length = centred[rows], min(about, len(rows))
        sums = (np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(v, axis=0)]) for v in (values, values**2))
        mean, square = ((total[length:] - total[:-length]) / length for total in sums)
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))
        first = np.clip(np.arange(len(rows)) - length // 2, 0, len(rows) - length)
        moves[rows] = np.any(spread > limit, axis=1)[first]
    return moves


def _spread_at_rest(observation: np.ndarray, run: np.ndarray, settings: MeasuredSettings) -> np.ndarray:
    """Standard deviation of each reading over a few rows, (n), up to which it stands still.

    It is a multiple of its noise, at least that of a reading that changes between two neighbouring values.
    """
    spread, steps = observation.std(0), np.abs(np.diff(observation, axis=0))
    noise = np.array([roughness_of(column, run) for column in observation.T])
    resolution = np.array([column[column > 0.0].min(initial=np.inf) for column in steps.T])
    least = np.maximum(settings.least_rest * spread, np.where(np.isfinite(resolution), resolution, 0.0))
    return np.clip(np.maximum(settings.rest * noise, least), 0.0, settings.most_rest * spread)
