"""The lag of the actions from sudden changes, where smooth motion does not show it."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings


def lag_of_events(response: Response, settings: AuditSettings) -> int:
    """Lag in rows at which sudden changes of the actions and of the accelerations coincide; 0 if it is not clear.

    If actions are smooth, errors of the friction and the masses hide the lag. Second differences of the velocities
    contain little of these errors. The lag must be significant, and the same for differences over one and two rows.
    """
    found = {_lag_of_changes(response, rows, settings) for rows in (1, 2)}
    return found.pop() if len(found) == 1 else 0


def _lag_of_changes(response: Response, rows: int, settings: AuditSettings) -> int:
    log, (first, last) = response.log, settings.action_lags
    velocity = np.vstack([log.observation[:, response.moving], log.following[-1:, response.moving]])
    sums = np.concatenate([np.zeros((1, response.actions.shape[1])), np.cumsum(response.limited, axis=0)])
    starts = np.arange(last, len(log) - 2 * rows + first)
    starts = starts[log.run[starts - last] == log.run[starts + 2 * rows - first - 1]]
    if len(starts) < settings.min_windows:
        return 0
    second = velocity[starts + 2 * rows] - 2.0 * velocity[starts + rows] + velocity[starts]
    scale = 1.4826 * np.median(np.abs(second), axis=0) + 1e-12
    slope = np.nan_to_num(np.nanmedian(response.by_action, axis=0)) / scale[:, None]
    wanted = np.clip(second / scale, -2.0 * settings.robust, 2.0 * settings.robust)
    left = []
    for lag in range(first, last + 1):
        begin = starts - lag
        changes = sums[begin + 2 * rows] - 2.0 * sums[begin + rows] + sums[begin]
        responses = (slope[None] * changes[:, None]).reshape(-1, changes.shape[1])
        gram = responses.T @ responses + 1e-12 * np.eye(changes.shape[1])
        explained = responses @ np.linalg.solve(gram, responses.T @ wanted.ravel())
        left.append(float(((wanted.ravel() - explained) ** 2).sum()))
    best, number = int(np.argmin(left)), len(starts) * len(scale) / (2 * rows)
    gained, at_zero = (np.log(left[-first] / left[best]), np.log(float((wanted**2).sum()) / left[-first]))
    clear = number * gained > settings.lag_significance and at_zero < 0.3 * gained
    return best + first if clear else 0
