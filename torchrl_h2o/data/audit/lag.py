"""The lag of the actions: from all motion, from sudden changes, and what each driven joint says of it."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.regression import ROBUST, Fit, fit, friction_responses, robust_fit, robust_weights
from torchrl_h2o.data.audit.response import MIN_WINDOWS, Response

LAGS = (-5, 40)  # rows by which actions may act early or late
LAG_LEAVES = 0.85  # share of the unexplained variance that another lag must leave at most
UNRELATED = 0.05  # share of the variance that actions of this run explain at least
REPEATED = 0.9  # correlation of the actions with themselves, some rows later, from which they repeat
CLEAR_LAG = 4  # rows of a lag of sudden changes from which it is reported, even if the whole motion does not show it
LAG_SIGNIFICANCE = 10.0  # logarithm of the likelihood ratio that such a lag must have against no lag
ORDINARY_LAG, ORDINARY_LAG_ROWS = 0.03, 3.5  # s and rows; lateness that is an ordinary property of drives
SEVERE_LAG = 0.1  # s; no drive is so late


def check_lag(response: Response, caused: float, lateness: float) -> tuple[list[Finding], int, Fit | None]:
    """Finds the lag at which the actions explain the accelerations best.

    Args:
        response: simulated windows.
        caused: share of the squared accelerations that the actions cause in the simulator.
        lateness: rows by which the velocities are late, which is no lag of the actions.

    Returns:
        What is wrong, the lag in rows, and the fit of the accelerations at that lag: the gains of the actions, then
        friction; None where the actions belong to another run.
    """
    lags = _lags(response)
    fits, explained = _over_lags(response, lags)
    best, none = int(np.argmax(explained)), int(np.flatnonzero(lags == 0)[0])
    if explained[best] < UNRELATED:
        return ([] if response.drowned else [_foreign(explained[best], caused)]), 0, None
    lag = int(lags[best])
    gained = 1.0 - explained[best] <= LAG_LEAVES * (1.0 - explained[none])
    sharp = 0 if gained else _lag_of_events(response)
    shown = sharp >= CLEAR_LAG and sharp in lags and explained[none + sharp] > UNRELATED
    if shown and -1 not in _votes(response, sharp):  # the whole motion need not show what sudden changes do
        return _late(response, sharp, lateness), sharp, fits[none + sharp]
    votes = _votes(response, lag) if gained and lag else {-1}
    if -1 in votes or votes == {0}:  # one driven joint has to agree, and none may contradict
        return [], 0, fits[none]
    if lag in (lags[0], lags[-1]):
        sure = lag in LAGS and not response.drowned  # beside a border that repeated actions set, it is not
        return ([_out_of_step(lag)] if sure else []), 0, None
    few = response.for_hypotheses()
    near = min((lag, lag - 1, lag + 1), key=few.misfit_at_lag)  # windows blur the lag by a row
    return _late(response, near, lateness), lag, fits[best]


def _lags(response: Response) -> np.ndarray:
    """The lags that are tried; of actions that repeat after some rows, those up to half as many.

    Sines that differ by half a period differ in sign alone, so they repeat after half of one.
    """
    first, last = LAGS
    varied = response.limited[:, np.ptp(response.limited, axis=0) > 0.0]
    varied = varied - varied.mean(0)
    alike, differed = np.ones(varied.shape[1]), False
    for rows in range(1, min(last, len(varied) // 2) + 1):
        early, late = varied[:-rows], varied[rows:]
        size = np.sqrt((early**2).sum(0) * (late**2).sum(0))
        alike = np.abs((early * late).sum(0)) / np.maximum(size, 1e-300)
        differed = differed or bool(alike.min() < 0.5)
        if differed and alike.min() > REPEATED:
            return np.arange(max(first, -(rows // 2)), rows // 2 + 1)
    return np.arange(first, last + 1)


def _over_lags(response: Response, lags: np.ndarray) -> tuple[list[Fit], np.ndarray]:
    """The fit at each lag, and the share of the variance beyond friction that the actions explain there."""
    friction = friction_responses(response)
    base = robust_fit(response.target, friction, response.scale)
    fits, explained = [], []
    for lag in lags:
        actions, known = response.mean_action(int(lag))
        if known.sum() < MIN_WINDOWS:
            fits.append(base)
            explained.append(0.0)
            continue
        found, share = _explained(response, actions, known, friction)
        fits.append(found)
        explained.append(share)
    return fits, np.array(explained)


def _explained(
    response: Response, actions: np.ndarray, known: np.ndarray, friction: np.ndarray, velocity: slice = slice(None)
) -> tuple[Fit, float]:
    """A fit of some windows by actions (W, nu), and the share of their variance beyond friction that actions explain.

    Args:
        response: simulated windows.
        actions: mean actions of the windows.
        known: windows to fit, (W,).
        friction: responses beside those of the actions, (W, m, P).
        velocity: the velocities to fit.
    """
    target, scale, friction = response.target[known, velocity], response.scale[velocity], friction[known, velocity]
    by_action = response.by_action[known, velocity] * actions[known, None]
    responses = np.concatenate([by_action, friction], -1)
    found = robust_fit(target, responses, scale)
    weights = np.isfinite(target) * robust_weights((target - responses @ found.values) / scale)
    without = fit(target, friction, scale, weights)
    return found, 1.0 - found.unexplained / max(without.unexplained, 1e-300)


def _votes(response: Response, lag: int) -> set[int]:
    """What the joints that actuators drive directly say of a lag: 1 if one agrees, -1 if one contradicts, 0 if neither.

    How a directly driven joint answers its motor depends least on what the simulator lacks elsewhere.
    """
    friction, votes = friction_responses(response), set()
    for index, velocity in enumerate(response.log.velocities):
        if not velocity.actuators or not np.ptp(response.limited[:, velocity.actuators], axis=0).any():
            continue
        known = response.mean_action(lag)[1] & response.mean_action(0)[1]
        if known.sum() < MIN_WINDOWS:
            continue
        at_zero, at_lag = (
            1.0 - _explained(response, response.mean_action(rows)[0], known, friction, slice(index, index + 1))[1]
            for rows in (0, lag)
        )
        votes.add(1 if at_lag < LAG_LEAVES * at_zero else -1 if at_zero < LAG_LEAVES * at_lag else 0)
    return votes


def _lag_of_events(response: Response) -> int:
    """Lag in rows at which sudden changes of the actions and of the accelerations coincide; 0 if it is not clear.

    If actions are smooth, errors of the friction and the masses hide the lag. Second differences of the velocities
    contain little of these errors. The lag must be significant, and the same for differences over one and two rows.
    """
    found = {_lag_of_changes(response, rows) for rows in (1, 2)}
    return found.pop() if len(found) == 1 else 0


def _lag_of_changes(response: Response, rows: int) -> int:
    log, (first, last) = response.log, LAGS
    velocity = np.vstack([log.observation[:, response.moving], log.following[-1:, response.moving]])
    sums = np.concatenate([np.zeros((1, response.actions.shape[1])), np.cumsum(response.limited, axis=0)])
    starts = np.arange(last, len(log) - 2 * rows + first)
    starts = starts[log.run[starts - last] == log.run[starts + 2 * rows - first - 1]]
    if len(starts) < MIN_WINDOWS:
        return 0
    second = velocity[starts + 2 * rows] - 2.0 * velocity[starts + rows] + velocity[starts]
    scale = 1.4826 * np.median(np.abs(second), axis=0) + 1e-12
    slope = np.nan_to_num(np.nanmedian(response.by_action, axis=0)) / scale[:, None]
    wanted = np.clip(second / scale, -2.0 * ROBUST, 2.0 * ROBUST)
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
    clear = number * gained > LAG_SIGNIFICANCE and at_zero < 0.3 * gained
    return best + first if clear else 0


def _late(response: Response, lag: int, lateness: float) -> list[Finding]:
    if lag > 0:
        lag = max(0, lag - round(lateness))
    if lag == 0:
        return []
    seconds = lag * response.log.dt
    words = f"the actions act {abs(lag)} rows ({1e3 * abs(seconds):.3g} ms) {'later' if lag > 0 else 'earlier'} than "
    words += "their rows say"
    if lag < 0:
        remedy = "shift the column of the actions: effects precede their cause"
        return [Finding("actions", "severe", words, None, remedy)]
    if seconds <= ORDINARY_LAG and lag <= ORDINARY_LAG_ROWS:
        words += ", as a drive's delay does"
        return [Finding("actions", "note", words, None, "a search may add ActionDelay")]
    remedy = "shift the column of the actions, unless the drive is that late"
    return [Finding("actions", "severe" if seconds > SEVERE_LAG else "warning", words, None, remedy)]


def _foreign(explained: float, caused: float) -> Finding:
    words = f"the actions explain {max(0.0, explained):.0%} of the accelerations at any lag and sign; in the simulator "
    words += f"they cause {min(caused, 1.0):.0%}: they belong to another run"
    return Finding("actions", "severe", words, None, "pair the log with its own actions")


def _out_of_step(lag: int) -> Finding:
    words = f"the accelerations agree with the actions best if these act {abs(lag)} rows or more "
    words += f"{'later' if lag > 0 else 'earlier'}: they belong to another run, or are far out of step"
    return Finding("actions", "severe", words, None, "pair the log with its own actions")
