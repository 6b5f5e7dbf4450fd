"""Hypotheses about the actions: gains, signs, order, lags, and actions of another run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.physics import BETTER, EVIDENCE, ROBUST, USUAL_GAINS, Explained, explain
from torchrl_h2o.data.audit.response import MIN_WINDOWS, Response
from torchrl_h2o.data.audit.rival import Rival, leaves

ANY_GAINS = (-1e6, 1e6)
UNIT_GAINS = (0.04, 25.0)  # gains outside these are a wrong unit
NO_GAINS = (0.0, 1e-9)
IDLE = 0.05  # effect of an action, in usual changes of the velocities, below which its gain is not known
OPPOSED = 2.0  # effect of all actions beyond which friction or a load takes most of it
LAGS = (-5, 40)  # rows by which actions may act early or late
CLEAR_LAG = 4  # rows of a lag of sudden changes from which it is reported, even if the whole motion does not show it
LAG_SIGNIFICANCE = 10.0  # logarithm of the likelihood ratio that such a lag must have against no lag
ORDINARY_LAG, ORDINARY_LAG_ROWS = 0.03, 3.5  # s and rows; lateness that is an ordinary property of drives
SEVERE_LAG = 0.1  # s; no drive is so late

_ORDER = "correct the order of the actions, or of the joints"
_SIGN = "reverse the sign of the action (scale: -1), or of the joint's position and velocity"


def gains(response: Response, plain: Explained) -> Iterator[Rival]:
    """Gains that no motor has, and actions that belong to another run.

    Args:
        response: simulated windows.
        plain: what simple physics explains of them.
    """
    free, none = explain(response, gains=ANY_GAINS), explain(response, gains=NO_GAINS)
    if none.share < free.share + IDLE and not is_opposed(response):  # no gains help either
        words = f"{leaves(plain, none)}the actions did nothing: they belong to another run"
        foreign = Finding("actions", "severe", words, None, "pair the log with its own actions")
        yield Rival(none, plain, (foreign,), enough=1.0)
    if response.is_known and (found := _findings(response, plain, free)):  # another rotor looks like another gain
        is_reversed = any(finding.remedy == _SIGN for finding in found)
        yield Rival(free, plain, found, enough=1.0 if is_reversed else BETTER)


def is_opposed(response: Response) -> bool:
    """Whether friction or a load takes most of what all actions do."""
    return _effect(response, response.by_gain.sum(-1, keepdims=True)).max() > OPPOSED


def _effect(response: Response, by_gain: np.ndarray) -> np.ndarray:
    """Largest usual effect of K actions (W, m, K) on a velocity, in its usual changes, (K,)."""
    usual = np.median(np.nan_to_num(np.abs(by_gain)), axis=0) / response.scale[:, None]
    return usual.max(0, initial=0.0)


def _findings(response: Response, plain: Explained, free: Explained) -> tuple[Finding, ...]:
    """What both fits with any gains say of each action."""
    found, (low, high), (far_low, far_high) = [], USUAL_GAINS, UNIT_GAINS
    effects = _effect(response, response.by_gain)
    for name, both, effect in zip(response.log.actuators, free.gains.T, effects, strict=True):
        if effect < IDLE:
            continue
        if both.max() < -far_low:
            words = f"{leaves(plain, free)}the action of {name} has the other sign"
            found.append(Finding("actions", "severe", words, None, _SIGN))
        elif both.max() < low or both.min() > high:
            far = both.max() < far_low or both.min() > far_high
            words = f"the accelerations follow {both.mean():.3g} × the action of {name}: "
            words += "the action looks like another unit" if far else "a weak or strong motor, other masses or units"
            words, remedy = f"{words}, or another robot's log", "compare unit and gear of the action with the model"
            found.append(Finding("actions", "severe" if far else "warning", words, None, remedy))
    return tuple(found)


def other_actions(few: Response, plain: Explained) -> Iterator[Rival]:
    """Actions with the other sign, or in another order, which are simulated.

    Args:
        few: windows, which are simulated for each hypothesis.
        plain: what simple physics explains of them.
    """
    log, count = few.log, few.actions.shape[1]
    for index, name in enumerate(log.actuators):
        explained = explain(few.driven_by(np.where(np.arange(count) == index, -1.0, 1.0) * few.actions))
        words = f"{leaves(plain, explained)}the action of {name} has the other sign"
        yield Rival(explained, plain, (Finding("actions", "severe", words, None, _SIGN),))
    for one, other in combinations(range(count), 2):
        order = np.arange(count)
        order[[one, other]] = other, one
        words = f"{log.moved_by(one)} follows the action of {log.actuators[other]} instead of {log.actuators[one]}"
        fault = Finding("actions", "severe", f"{words}: the columns are exchanged", None, _ORDER)
        yield Rival(explain(few.driven_by(few.actions[:, order])), plain, (fault,))


def late_actions(few: Response, lateness: float) -> Iterator[Rival]:
    """Actions that act some rows earlier or later than their rows say."""
    first, found = LAGS[0], {}
    for last in (LAGS[1] >> halves for halves in range(4)):  # fewer in short runs
        known = few.mean_action(first)[1] & few.mean_action(last)[1]
        if known.mean() > 0.5:
            few = few.at(known)
            for lag in range(first, last + 1):
                found[lag] = explain(few.driven_by(_late_by(lag, few.actions, few.log.runs)))
            break
    best = min(found, key=lambda lag: found[lag].share, default=0)
    if best and (said := _late(few, best, lateness)):
        yield Rival(found[best], found[0], said)


def _late_by(lag: int, actions: np.ndarray, runs: Sequence[slice]) -> np.ndarray:
    """Actions some rows later in each run, (T, nu); the first or last ones of a run are repeated at its end."""
    rows = [np.clip(np.arange(run.start, run.stop) - lag, run.start, run.stop - 1) for run in runs]
    return actions[np.concatenate(rows)]


def late_changes(response: Response, lateness: float) -> tuple[Finding, ...]:
    """A lag at which sudden changes of the actions and of the accelerations coincide, if it is clear.

    If actions are smooth, errors of the friction and the masses hide the lag. Second differences of the velocities
    contain little of these errors. The lag must be significant, and the same for differences over one and two rows, and
    the whole motion must not speak against it.
    """
    found = {_lag_of_changes(response, rows) for rows in (1, 2)}
    lag = found.pop()
    if found or lag < CLEAR_LAG:
        return ()
    known = response.at(response.mean_action(lag)[1])
    late = known.driven_by(_late_by(lag, known.actions, known.log.runs))
    speaks_against = explain(known).evidence(explain(late)) > EVIDENCE
    return () if speaks_against else _late(response, lag, lateness)


def _lag_of_changes(response: Response, rows: int) -> int:
    log, (first, last) = response.log, LAGS
    velocity = np.vstack([log.observation[:, response.moving], log.following[-1:, response.moving]])
    sums = np.concatenate([np.zeros((1, response.actions.shape[1])), np.cumsum(response.limited, axis=0)])
    starts = np.arange(last, len(log) - 2 * rows + first)
    starts = starts[log.run[starts - last] == log.run[starts + 2 * rows - first - 1]]
    if len(starts) < MIN_WINDOWS or not sums.any():
        return 0
    second = velocity[starts + 2 * rows] - 2.0 * velocity[starts + rows] + velocity[starts]
    scale = 1.4826 * np.median(np.abs(second), axis=0) + 1e-12
    slope = np.median(np.nan_to_num(response.by_action), axis=0) / scale[:, None]
    wanted = np.clip(second / scale, -2.0 * ROBUST, 2.0 * ROBUST)
    left = []
    for lag in range(first, last + 1):
        begin = starts - lag
        changes = sums[begin + 2 * rows] - 2.0 * sums[begin + rows] + sums[begin]
        responses = (slope[None] * changes[:, None]).reshape(-1, changes.shape[1])
        gram = responses.T @ responses + 1e-12 * np.eye(changes.shape[1])
        explained = responses @ np.linalg.solve(gram, responses.T @ wanted.ravel())
        left.append(float(((wanted.ravel() - explained) ** 2).sum()) + 1e-12)
    best, number = int(np.argmin(left)), len(starts) * len(scale) / (2 * rows)
    gained, at_zero = (np.log(left[-first] / left[best]), np.log((float((wanted**2).sum()) + 1e-12) / left[-first]))
    clear = number * gained > LAG_SIGNIFICANCE and at_zero < 0.3 * gained
    return best + first if clear else 0


def _late(response: Response, lag: int, lateness: float) -> tuple[Finding, ...]:
    if lag > 0:
        lag = max(0, lag - round(lateness))
    if lag == 0:
        return ()
    seconds = lag * response.log.dt
    words = f"the actions act {abs(lag)} rows ({1e3 * abs(seconds):.3g} ms) {'later' if lag > 0 else 'earlier'} than "
    words += "their rows say"
    if lag < 0:
        remedy = "shift the column of the actions: effects precede their cause"
        return (Finding("actions", "severe", words, None, remedy),)
    if seconds <= ORDINARY_LAG and lag <= ORDINARY_LAG_ROWS:
        words += ", as a drive's delay does"
        return (Finding("actions", "note", words, None, "a search may add ActionDelay"),)
    remedy = "shift the column of the actions, unless the drive is that late"
    return (Finding("actions", "severe" if seconds > SEVERE_LAG else "warning", words, None, remedy),)
