"""The rows of a log in which something moves."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.derivative import roughness_of

REST_ROWS = 10  # rows by which it is judged whether something moves
REST = 2.0  # standard deviation of a reading over these rows, in that of its noise, up to which it stands still
LEAST_REST = 1e-3  # the same in spreads, for sensors without noise
# the same in spreads, for sensors so noisy, or rows so far apart, that their noise cannot be told from motion
MOST_REST = 0.05


def moving_rows(observation: np.ndarray, run: np.ndarray) -> np.ndarray:
    """The rows about which a reading changes by more than its noise, mask (T,).

    Each row is judged by the standard deviation of the readings in the rows about it, within its run.

    Args:
        observation: (T, n), readings.
        run: (T), index of each row's run, ascending.

    Examples:
        >>> readings = np.concatenate([np.zeros((40, 1)), np.sin(np.arange(60.0))[:, None]])
        >>> moves = moving_rows(readings, np.zeros(100, int))
        >>> bool(moves[:30].any()), bool(moves[50:].all())
        (False, True)
    """
    limit, about = _spread_at_rest(observation, run), REST_ROWS
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


def _spread_at_rest(observation: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Standard deviation of each reading over a few rows, (n), up to which it stands still.

    It is a multiple of its noise, at least that of a reading that changes between two neighbouring values.
    """
    spread, steps = observation.std(0), np.abs(np.diff(observation, axis=0))
    noise = np.array([roughness_of(column, run) for column in observation.T])
    resolution = np.array([column[column > 0.0].min(initial=np.inf) for column in steps.T])
    least = np.maximum(LEAST_REST * spread, np.where(np.isfinite(resolution), resolution, 0.0))
    return np.clip(np.maximum(REST * noise, least), 0.0, MOST_REST * spread)
