"""Checks of the actions against the accelerations: sign, unit, order, lag; constant, saturated and clipped actions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.lag import check_lag
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.data.audit.regression import (
    BETTER,
    GAIN_WARNING,
    MISFIT,
    NEGLIGIBLE,
    SIGNIFICANCE,
    Fit,
    fit,
    friction_dominates,
    friction_responses,
    robust_fit,
    robust_weights,
)
from torchrl_h2o.data.audit.response import MIN_WINDOWS, Response

CHECK = "actions"
OUTSIDE_RANGE = 0.001  # share of actions outside an actuator's range from which they are named
ACTIONS_MATTER = 0.15  # share of the explained change that actions must cause before they are judged
ACTIONS_SHOW = 0.3  # square of what actions do and friction would not, over that of what stays unexplained
GAIN_SEVERE = (0.04, 25.0)  # gains outside these are a wrong unit
SATURATED, MOSTLY_SATURATED = 0.2, 0.9  # share of actions at their extreme for a note; for a warning


def check_actions(log: Log, response: Response | None, *, lateness: float = 0.0, gains: bool = True) -> list[Finding]:
    """Compares the measured accelerations with those that the actions cause in the simulator.

    The change of the velocities within a window is fitted by the actions' responses, at every lag, beside dry and
    viscous friction and a constant force of each joint, so that these do not look like a wrong gain.

    Args:
        log: the data.
        response: simulated windows; None if the simulator cannot be consulted, which leaves the plain checks.
        lateness: rows by which the velocities are late against their positions; the accelerations are as late, which
            is no lag of the actions.
        gains: whether to compare the sizes of the actions' effects as well.
    """
    found = _plain(log, response)
    if response is None or not log.action.shape[1] or not np.ptp(log.action, axis=0).any():
        return found
    return [*found, *_against_accelerations(response, lateness, gains)]


def _plain(log: Log, response: Response | None) -> list[Finding]:
    found = []
    for index, name in enumerate(log.actuators):
        values = log.action[:, index]
        if np.ptp(values) == 0.0:
            found.append(_constant(log, index, response))
            continue
        ends = (values == values.min()) | (values == values.max())
        if ends.mean() > SATURATED:
            severity = "warning" if ends.mean() > MOSTLY_SATURATED else "note"
            words = f"{ends.mean():.0%} of the actions of {name} are at their extremes"
            remedy = "vary the actions within their range: the response to small actions does not show"
            found.append(Finding(CHECK, severity, words, Rows.of(ends), remedy))
    if response is not None:
        found += _beyond_range(log, response)
    return found


def _constant(log: Log, index: int, response: Response | None) -> Finding:
    name, value = log.actuators[index], log.action[0, index]
    explained = response is not None and response.misfit() < MISFIT
    words = f"the action of {name} is {value:.4g} in all rows"
    if explained:
        return Finding(CHECK, "note", words + "; the motion agrees with that", None, "record the motor at work as well")
    moved = "" if response is None else ", and the simulator does not move like the log without other actions"
    severity = "warning" if response is None else "severe"
    return Finding(CHECK, severity, words + moved, None, "find the column that holds the action")


def _beyond_range(log: Log, response: Response) -> list[Finding]:
    model, found = response.simulation.model, []
    for index, name in enumerate(log.actuators):
        if not model.actuator_ctrllimited[index]:
            continue
        low, high = model.actuator_ctrlrange[index]
        margin = 1e-3 * (high - low)
        outside = (log.action[:, index] < low - margin) | (log.action[:, index] > high + margin)
        usual = float(np.median(np.abs(log.action[:, index])))
        far = usual > 3.0 * max(abs(low), abs(high))
        if outside.mean() > OUTSIDE_RANGE:
            words = f"{outside.mean():.0%} of the actions of {name} lie outside the range of its actuator, {low:.4g} "
            words += f"to {high:.4g}, up to {np.abs(log.action[:, index]).max():.4g}; the simulator clips them"
            words += ": they look like another unit" if far else ""
            severity = "severe" if far else "warning"
            remedy = "correct the unit of the action, or the actuator's range in the model"
            found.append(Finding(CHECK, severity, words, Rows.of(outside), remedy))
    return found


def _against_accelerations(response: Response, lateness: float, gains: bool) -> list[Finding]:
    if reversed_ones := _reversed(response):
        return reversed_ones
    known = np.isfinite(response.target).all(1) & np.isfinite(response.by_gain).all((1, 2))
    caused = _caused(response) if known.sum() >= MIN_WINDOWS else None
    if caused is None:
        return []
    found, lag, own = check_lag(response, caused, lateness)
    if own is None:
        return found
    order = _exchanged(response, lag, own)
    if order or not gains or friction_dominates(response):
        return [*found, *order]
    return [*found, *_gains(response, own)]


def _reversed(response: Response) -> list[Finding]:
    """Actions with which the simulator fits much better if their sign is changed."""
    few = response.for_hypotheses()
    misfit = few.misfit()
    if misfit <= 0.5 * MISFIT:
        return []
    found = []
    for index, name in enumerate(few.log.actuators):
        left = few.misfit(actions=reversed_action(index))
        if left < BETTER * misfit:
            words = f"the simulator leaves {misfit:.0%} of the accelerations unexplained, and {left:.0%} if the action "
            words += f"of {name} has the other sign"
            remedy = "reverse the sign of the action (scale: -1), or of the joint's position and velocity"
            found.append(Finding(CHECK, "severe", words, None, remedy))
    return found


def reversed_action(index: int) -> Callable[[np.ndarray], np.ndarray]:
    """Function that changes the sign of one entry of actions (..., nu)."""

    def change(actions: np.ndarray) -> np.ndarray:
        changed = actions.copy()
        changed[..., index] *= -1.0
        return changed

    return change


def _caused(response: Response) -> float | None:
    """Share of the squared accelerations that the actions cause in the simulator; None if that tells nothing of them.

    It does not where the share is small, or where the actions act as friction would. Torques that pump or damp a swing
    follow the velocity as viscous friction does. Their lag, sign and size then show in what little differs from it, and
    errors of the simulator are larger than that.
    """
    number, responses = (
        len(response.log.actuators),
        np.concatenate([response.by_gain, friction_responses(response)], -1),
    )
    known = np.isfinite(response.target) & np.isfinite(responses).all(-1)
    target, responses = np.where(known, response.target, 0.0), np.where(known[..., None], responses, 0.0)
    left = target - responses @ robust_fit(target, responses, response.scale).values
    weights = known * robust_weights(left / response.scale)
    together, like_friction = responses[..., :number].sum(-1), responses[..., number:]
    beyond = together - like_friction @ fit(together, like_friction, response.scale, weights).values
    size, caused, special, rest = (
        float((weights * (part / response.scale) ** 2).sum()) for part in (target, together, beyond, left)
    )
    return caused / size if caused >= ACTIONS_MATTER * size > 0.0 and special >= ACTIONS_SHOW * rest else None


def _gains(response: Response, found: Fit) -> list[Finding]:
    """Gains of the actions that are negative, or far from the simulator's."""
    findings, (low, high), (far_low, far_high) = [], GAIN_WARNING, GAIN_SEVERE
    sizes = np.nanmedian((np.abs(response.by_gain) / response.scale[:, None]).max(1), axis=0)
    for index in np.flatnonzero(sizes >= NEGLIGIBLE):
        name, gain, unsure = response.log.actuators[index], found.values[index], SIGNIFICANCE * found.errors[index]
        if gain < -max(unsure, far_low):
            words = f"the accelerations follow {gain:.2f} × the action of {name}: its sign is reversed"
            remedy = "reverse the sign of the action (scale: -1), or of the joint's position and velocity"
            findings.append(Finding(CHECK, "severe", words, None, remedy))
        elif gain + unsure < low or gain - unsure > high:
            far = gain + unsure < far_low or gain - unsure > far_high
            words = f"the accelerations follow {gain:.3g} × the action of {name}"
            words += (
                ": the action looks like another unit" if far else ": a weak or strong motor, other masses or units"
            )
            remedy = "compare unit and gear of the action with the model"
            findings.append(Finding(CHECK, "severe" if far else "warning", words, None, remedy))
    return findings


def _exchanged(response: Response, lag: int, own: Fit) -> list[Finding]:
    """Actuators whose joint follows the action of another column and not its own.

    The actions in the other order must also leave much less of the accelerations unexplained than in their own, whose
    fit is ``own``, with any gains. Where the simulator lacks rotors and much friction, a gain of every action on every
    joint imitates these.
    """
    actions, known = response.mean_action(lag)
    number = actions.shape[1]
    if number < 2:
        return []
    target, friction = response.target[known], friction_responses(response)[known]
    by_action, actions = response.by_action[known], actions[known]
    each = by_action[..., :, None] * actions[:, None, None, :]
    found = robust_fit(target, np.concatenate([each.reshape(*target.shape, -1), friction], -1), response.scale)
    spread = actions.std(0) + 1e-12
    gains = np.abs(found.values[: number**2].reshape(number, number)) * spread
    errors = found.errors[: number**2].reshape(number, number) * spread
    findings, order, names = [], np.arange(number), response.log.actuators
    for index, other in enumerate(gains.argmax(1)):
        strongest = gains[index, other]
        # 0.4: the gain of the simulator's own actuator is 1
        clear = strongest > max(SIGNIFICANCE * errors[index, other], 0.4 * spread[other])
        if clear and gains[index, index] < 0.3 * strongest:
            words = f"{response.log.moved_by(index)} follows the action of {names[other]} instead of {names[index]}"
            remedy = "correct the order of the actions, or of the joints"
            findings.append(Finding(CHECK, "severe", words + ": the columns are exchanged", None, remedy))
            order[index] = other
    if not findings:
        return []
    in_order = robust_fit(target, np.concatenate([by_action * actions[:, None, order], friction], -1), response.scale)
    return findings if in_order.unexplained < BETTER * own.unexplained else []
