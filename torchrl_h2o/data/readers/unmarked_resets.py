"""Finds transitions that lead from one episode into the next, in files that do not mark time limits."""

from __future__ import annotations

import numpy as np

USUAL = 0.99  # quantile of the steps of a column
LARGE = 3.0  # times the usual step of a column
NEAR = 0.5  # times the distance to the nearest start before the step


def unmarked_resets(observation: np.ndarray, next_observation: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Find the rows whose next observation is the start of another episode.

    Some files take the next observation of every row from the following row, also where the environment was reset
    between them. Such a row has a large step in some column, and leads near a known start: the first row, and the rows
    after an end. The distance to a start is that of all columns, in standard deviations.

    In the 18 files of the off-dynamics benchmark (Lyu et al., ICLR 2025) on which the test was chosen, all 21 resets
    are found: their largest step is at least 3.5 usual ones, and it shrinks the distance to a start to at most 0.45 of
    what it was. No other step of 3 usual ones, in these files, Minari's HalfCheetah and Walker2d and logs of machines,
    shrinks it below 0.69.

    Args:
        observation: observations, (T, n).
        next_observation: observations after the actions, (T, n).
        ends: whether an episode is known to end with the row, (T,), bool.

    Returns:
        Whether a row leads into the next episode, (T,), bool.

    Example:
        >>> angle = np.append(np.linspace(0.0, 5.0, 200), np.linspace(0.01, 4.0, 200))[:, None]
        >>> unmarked_resets(angle[:-1], angle[1:], np.zeros(399, bool)).nonzero()[0].tolist()
        [199]
    """
    from scipy.spatial import KDTree  # imported here, because the replay buffer does not need it

    resets = np.zeros(len(observation), bool)
    observation, next_observation = observation.astype(np.float64), next_observation.astype(np.float64)
    step = np.abs(next_observation - observation)
    usual = np.quantile(step, USUAL, axis=0)
    rows = np.flatnonzero(((step > LARGE * usual) & (usual > 0.0)).any(1))
    if not len(rows):
        return resets
    deviation = observation.std(0)
    scale = np.where(deviation > 0.0, deviation, 1.0)
    starts = KDTree(observation[np.append(0, np.flatnonzero(ends[:-1]) + 1)] / scale)
    before, after = (starts.query(values[rows] / scale)[0] for values in (observation, next_observation))
    resets[rows] = after < NEAR * before
    return resets
