"""Checks of the actions against the accelerations: lag, sign, unit, order, another run; constant and saturated ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.lag import lag_of_events
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.data.audit.regression import Fit, fit, robust_fit, robust_weights
from torchrl_h2o.data.audit.response import Response, joint_of
from torchrl_h2o.data.audit.settings import AuditSettings

CHECK = "actions"


def check_actions(
    log: Log, response: Response | None, settings: AuditSettings, *, lateness: float = 0.0, gains: bool = True
) -> list[Finding]:
    """Compares the measured accelerations with those that the actions cause in the simulator.

    The change of the velocities within a window is fitted by the actions' responses, at every lag, beside dry and
    viscous friction and a constant force of each joint, so that these do not look like a wrong gain.

    Args:
        log: the data.
        response: simulated windows; None if the simulator cannot be consulted, which leaves the plain checks.
        settings: thresholds.
        lateness: rows by which the velocities are late against their positions; the accelerations are as late, which
            is no lag of the actions.
        gains: whether to compare the sizes of the actions' effects as well.
    """
    found = _plain(log, response, settings)
    if response is None or not log.action.shape[1] or not np.ptp(log.action, axis=0).any():
        return found
    return [*found, *_against_accelerations(response, settings, lateness, gains)]


def _plain(log: Log, response: Response | None, settings: AuditSettings) -> list[Finding]:
    found = []
    for index, name in enumerate(log.actuators):
        values = log.action[:, index]
        if np.ptp(values) == 0.0:
            found.append(_constant(log, index, response, settings))
            continue
        ends = (values == values.min()) | (values == values.max())
        if ends.mean() > settings.saturated:
            severity = "warning" if ends.mean() > settings.mostly_saturated else "note"
            words = f"{ends.mean():.0%} of the actions of {name} are at their extremes"
            remedy = "vary the actions within their range: the response to small actions does not show"
            found.append(Finding(CHECK, severity, words, Rows.of(ends, settings.examples), remedy))
    if response is not None:
        found += _beyond_range(log, response, settings)
    return found


def _constant(log: Log, index: int, response: Response | None, settings: AuditSettings) -> Finding:
    name, value = log.actuators[index], log.action[0, index]
    explained = response is not None and response.misfit() < settings.misfit
    words = f"the action of {name} is {value:.4g} in all rows"
    if explained:
        return Finding(CHECK, "note", words + "; the motion agrees with that", None, "record the motor at work as well")
    moved = "" if response is None else ", and the simulator does not move like the log without other actions"
    severity = "warning" if response is None else "severe"
    return Finding(CHECK, severity, words + moved, None, "find the column that holds the action")


def _beyond_range(log: Log, response: Response, settings: AuditSettings) -> list[Finding]:
    model, found = response.simulation.model, []
    for index, name in enumerate(log.actuators):
        if not model.actuator_ctrllimited[index]:
            continue
        low, high = model.actuator_ctrlrange[index]
        margin = 1e-3 * (high - low)
        outside = (log.action[:, index] < low - margin) | (log.action[:, index] > high + margin)
        usual = float(np.median(np.abs(log.action[:, index])))
        far = usual > 3.0 * max(abs(low), abs(high))
        if outside.mean() > settings.repeated:
            words = (
                f"{outside.mean():.0%} of the actions of {name} lie outside the range of its actuator, {low:.4g} to "
            )
            words += f"{high:.4g}, up to {np.abs(log.action[:, index]).max():.4g}; the simulator clips them"
            words += ": they look like another unit" if far else ""
            severity = "severe" if far else "warning"
            remedy = "correct the unit of the action, or the actuator's range in the model"
            found.append(Finding(CHECK, severity, words, Rows.of(outside, settings.examples), remedy))
    return found


def _against_accelerations(response: Response, settings: AuditSettings, lateness: float, gains: bool) -> list[Finding]:
    reversed_ones = _reversed(response, settings)
    if reversed_ones:
        return reversed_ones
    effect, target, nuisance = response.by_gain, response.target, friction_responses(response)
    known = np.isfinite(target).all(1) & np.isfinite(effect).all((1, 2))
    if known.sum() < settings.min_windows:
        return []
    base = robust_fit(target, nuisance, response.scale, settings.robust)
    caused = _caused(response, effect, nuisance, settings)
    if caused is None:
        return []
    lags, explained, fits = _over_lags(response, target, nuisance, base, settings)
    best = int(np.argmax(explained))
    found, lag = [], int(lags[best])
    if explained[best] < settings.unrelated:
        return [] if response.drowned else [_foreign_actions(explained[best], caused)]
    gained = (1.0 - explained[best]) <= settings.lag_share * (1.0 - explained[-lags[0]])
    sharp = 0 if gained else lag_of_events(response, settings)
    if sharp >= settings.clear_lag and explained[sharp - lags[0]] > settings.unrelated:
        best = int(sharp - lags[0])
        found += _late(response, sharp, settings, lateness)
    elif gained and lag != 0:
        if best in (0, len(lags) - 1):
            return [] if response.drowned else [_out_of_step(lag)]
        few = response.for_hypotheses()
        lag = min((lag, lag - 1, lag + 1), key=few.misfit_at_lag)  # windows blur the lag by a row
        found += _late(response, lag, settings, lateness)
    else:
        best = int(-lags[0])
    order = _exchanged(response, target, nuisance, int(lags[best]), fits[best], settings)
    if order or not gains or friction_dominates(response, settings):
        return [*found, *order]
    return [*found, *_gains(response, fits[best], settings)]


def _reversed(response: Response, settings: AuditSettings) -> list[Finding]:
    """Actions with which the simulator fits much better if their sign is changed."""
    few = response.for_hypotheses()
    misfit = few.misfit()
    if misfit <= 0.5 * settings.misfit:
        return []
    found = []
    for index, name in enumerate(few.log.actuators):
        left = few.misfit(actions=reversed_action(index))
        if left < settings.better * misfit:
            words = (
                f"the simulator leaves {misfit:.0%} of the accelerations unexplained, and {left:.0%} if the action of "
            )
            words += f"{name} has the other sign"
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


def _caused(response: Response, effect: np.ndarray, nuisance: np.ndarray, settings: AuditSettings) -> float | None:
    """Share of the squared accelerations that the actions cause in the simulator; None if that tells nothing of them.

    It does not where the share is small, or where the actions act as friction would. Torques that pump or damp a swing
    follow the velocity as viscous friction does. Their lag, sign and size then show in what little differs from it, and
    errors of the simulator are larger than that.
    """
    responses = np.concatenate([effect, nuisance], -1)
    known = np.isfinite(response.target) & np.isfinite(responses).all(-1)
    target, responses = np.where(known, response.target, 0.0), np.where(known[..., None], responses, 0.0)
    left = target - responses @ robust_fit(target, responses, response.scale, settings.robust).values
    weights = known * robust_weights(left / response.scale, settings.robust)
    together, like_friction = responses[..., : effect.shape[-1]].sum(-1), responses[..., effect.shape[-1] :]
    beyond = together - like_friction @ fit(together, like_friction, response.scale, weights).values
    caused, special = (_share(part, target, response.scale, weights) for part in (together, beyond))
    unexplained = _share(left, target, response.scale, weights)
    matters, shows = caused >= settings.action_matters, special >= settings.action_shows * unexplained
    return caused if matters and shows else None


def _share(part: np.ndarray, whole: np.ndarray, scale: np.ndarray, weights: np.ndarray) -> float:
    return float((weights * (part / scale) ** 2).sum() / max((weights * (whole / scale) ** 2).sum(), 1e-300))


def friction_responses(response: Response) -> np.ndarray:
    """Responses to dry friction, viscous friction and a constant force of each joint, (W, m, 3 · pairs)."""
    velocity = 0.5 * (2.0 * response.before + response.change)
    spread = np.maximum(velocity.std(0), 1e-12)
    terms = (np.tanh(velocity / (0.1 * spread)), velocity / spread, np.ones_like(velocity))
    return np.concatenate([response.by_force * term[:, None] for term in terms], axis=-1)


def friction_dominates(response: Response, settings: AuditSettings) -> bool:
    """Whether friction takes most of what the motors do, with the gains that they have in the simulator.

    This is usual in geared arms. What a fit leaves is then small beside the actions' effect, even if it is large beside
    the motion, and the fit trades the gain of a motor against friction. Constant forces and gravity, which a motor may
    have to hold, are no friction: they are taken out first.
    """
    effect = response.by_gain.sum(-1)
    dry, viscous, constant = np.split(friction_responses(response), 3, axis=-1)
    held = np.concatenate([constant, response.by_zero], -1)
    with_friction = np.concatenate([held, dry, viscous], -1)
    varied = _usual_rest(effect, held, response, settings)
    without, rest = (_usual_rest(response.target - effect, by, response, settings) for by in (held, with_friction))
    driven = varied > settings.negligible
    return bool(rest[driven].sum() < settings.cancelled * min(varied[driven].sum(), without[driven].sum()))


def _usual_rest(target: np.ndarray, responses: np.ndarray, response: Response, settings: AuditSettings) -> np.ndarray:
    """Median size of what a fit of a target (W, m) leaves, in usual changes of the velocities, (m,)."""
    found = robust_fit(target, responses, response.scale, settings.robust)
    return np.nanmedian(np.abs(target - responses @ found.values), axis=0) / response.scale


def _over_lags(
    response: Response, target: np.ndarray, nuisance: np.ndarray, base: Fit, settings: AuditSettings
) -> tuple[np.ndarray, np.ndarray, list[Fit]]:
    """Share of the target's variance beyond friction that the actions explain, at each lag."""
    first, last = settings.action_lags
    lags, explained, fits = np.arange(first, last + 1), [], []
    for lag in lags:
        actions, known = response.mean_action(int(lag))
        responses = np.concatenate([response.by_action * actions[:, None], nuisance], -1)
        if known.sum() < settings.min_windows:
            explained.append(0.0)
            fits.append(base)
            continue
        found = robust_fit(target[known], responses[known], response.scale, settings.robust)
        without = fit(
            target[known],
            nuisance[known],
            response.scale,
            np.isfinite(target[known])
            * robust_weights((target[known] - responses[known] @ found.values) / response.scale, settings.robust),
        )
        explained.append(1.0 - found.unexplained / max(without.unexplained, 1e-300))
        fits.append(found)
    return lags, np.array(explained), fits


def _foreign_actions(explained: float, caused: float) -> Finding:
    return Finding(
        CHECK,
        "severe",
        f"the actions explain {max(0.0, explained):.0%} of the accelerations at any lag and sign; in the simulator "
        f"they cause {min(caused, 1.0):.0%}: they belong to another run",
        None,
        "pair the log with its own actions",
    )


def _out_of_step(lag: int) -> Finding:
    words = f"the accelerations agree with the actions best if these act {abs(lag)} rows or more "
    words += f"{'later' if lag > 0 else 'earlier'}: they belong to another run, or are far out of step"
    return Finding(CHECK, "severe", words, None, "pair the log with its own actions")


def _late(response: Response, lag: int, settings: AuditSettings, lateness: float) -> list[Finding]:
    if lag > 0:
        lag = max(0, lag - round(lateness))
    if lag == 0:
        return []
    seconds = lag * response.log.dt
    words = f"the actions act {abs(lag)} rows ({1e3 * abs(seconds):.3g} ms) {'later' if lag > 0 else 'earlier'} than "
    words += "their rows say"
    if lag < 0:
        return [Finding(CHECK, "severe", words, None, "shift the column of the actions: effects precede their cause")]
    if seconds <= settings.ordinary_lag and lag <= settings.ordinary_lag_rows:
        return [Finding(CHECK, "note", words + ", as a drive's delay does", None, "a search may add ActionDelay")]
    severity = "severe" if seconds > settings.severe_lag else "warning"
    remedy = "shift the column of the actions, unless the drive is that late"
    return [Finding(CHECK, severity, words, None, remedy)]


def _gains(response: Response, found: Fit, settings: AuditSettings) -> list[Finding]:
    findings, names = [], response.log.actuators
    size = _sizes(response)
    for index, name in enumerate(names):
        gain, error = found.values[index], found.errors[index]
        if size[index] < settings.negligible:
            continue
        low, high = settings.gain_warning
        if gain < 0.0 and abs(gain) > settings.significance * error and abs(gain) > settings.gain_severe[0]:
            words = f"the accelerations follow {gain:.2f} × the action of {name}: its sign is reversed"
            remedy = "reverse the sign of the action (scale: -1), or of the joint's position and velocity"
            findings.append(Finding(CHECK, "severe", words, None, remedy))
            continue
        below, above = gain + settings.significance * error < low, gain - settings.significance * error > high
        if not (below or above):
            continue
        far_low, far_high = settings.gain_severe
        far = gain + settings.significance * error < far_low or gain - settings.significance * error > far_high
        words = f"the accelerations follow {gain:.3g} × the action of {name}"
        words += ": the action looks like another unit" if far else ": a weak or strong motor, other masses or units"
        remedy = "compare unit and gear of the action with the model"
        findings.append(Finding(CHECK, "severe" if far else "warning", words, None, remedy))
    return findings


def _sizes(response: Response) -> np.ndarray:
    """Usual size of each action's effect in the simulator, in usual changes of the velocities, (nu,)."""
    effect = np.abs(response.by_gain) / response.scale[:, None]
    return np.nanmedian(effect.max(1), axis=0)


def _exchanged(
    response: Response, target: np.ndarray, nuisance: np.ndarray, lag: int, own: Fit, settings: AuditSettings
) -> list[Finding]:
    """Actuators whose joint follows the action of another column and not its own.

    The actions in the other order must also leave much less of the accelerations unexplained than in their own, whose
    fit is ``own``, with any gains. Where the
    simulator lacks rotors and much friction, a gain of every action on every joint imitates these.
    """
    actions, known = response.mean_action(lag)
    number = actions.shape[1]
    if number < 2:
        return []
    each = response.by_action[..., :, None] * actions[:, None, None, :]
    responses = np.concatenate([each.reshape(*target.shape, -1), nuisance], -1)
    found = robust_fit(target[known], responses[known], response.scale, settings.robust)
    spread = actions.std(0) + 1e-12
    gains = found.values[: number**2].reshape(number, number) * spread
    errors = found.errors[: number**2].reshape(number, number) * spread
    strongest = np.abs(gains).argmax(1)
    findings, order = [], np.arange(number)
    for index in np.flatnonzero(strongest != np.arange(number)):
        other = int(strongest[index])
        clear = abs(gains[index, other]) > settings.significance * errors[index, other]
        # 0.4: the gain of the simulator's own actuator is 1
        strong = abs(gains[index, other]) > 0.4 * spread[other]
        if clear and strong and abs(gains[index, index]) < 0.3 * abs(gains[index, other]):
            names, joint = response.log.actuators, joint_of(response.simulation.model, int(index), response.log.pairs)
            where = names[index] if joint is None else response.log.pairs[joint].name
            words = f"{where} follows the action of {names[other]} instead of {names[index]}: the columns are exchanged"
            findings.append(Finding(CHECK, "severe", words, None, "correct the order of the actions, or of the joints"))
            order[index] = other
    if not findings:
        return []
    responses = np.concatenate([response.by_action * actions[:, None, order], nuisance], -1)
    other_order = robust_fit(target[known], responses[known], response.scale, settings.robust)
    return findings if other_order.unexplained < settings.better * own.unexplained else []
