"""Faults of the columns, such as signs, order, units, zeros and lags, that explain a log better than physics do."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.physics import (
    BETTER,
    EVIDENCE,
    ROBUST,
    SMALL_ZERO,
    USUAL_GAINS,
    Explained,
    explain,
    percent,
)
from torchrl_h2o.data.audit.response import MIN_WINDOWS, Response

ANY_GAINS = (-1e6, 1e6)
UNIT_GAINS = (0.04, 25.0)  # gains outside these are a wrong unit
NO_GAINS = (0.0, 1e-9)
ZERO_SIGNAL = 10.0  # change of the velocities in windows that tell a zero, in standard deviations of their noise
HELD = 2.0  # effects of the actions, in usual changes of a velocity, of which friction or a load takes most
LAGS = (-5, 40)  # rows by which actions may act early or late
CLEAR_LAG = 4  # rows of a lag of sudden changes from which it is reported, even if the whole motion does not show it
LAG_SIGNIFICANCE = 10.0  # logarithm of the likelihood ratio that such a lag must have against no lag
ORDINARY_LAG, ORDINARY_LAG_ROWS = 0.03, 3.5  # s and rows; lateness that is an ordinary property of drives
SEVERE_LAG = 0.1  # s; no drive is so late
ROTORS = (1.0, 3.0, 10.0, 30.0, 100.0)  # inertias of rotors that are tried, in inertias of their joint
FOREIGN = 0.85  # share that is left above which a log may belong to another robot
CLEAR = 0.2  # share of what simple physics leaves that leaves no room for another hypothesis
LITTLE = 0.05  # share that is left below which no fault of the columns is sought
TURN_STEPS = 12  # shifts of an angle that are tried around the circle
SHORTEST_PART = 12  # windows of a part of the log with its own zero
ALIKE = 0.05  # difference between two hypotheses below which the first is said
PARALLEL = 0.999  # cosine of the angle between two joints' axes

_ORDER = "correct the order of the actions, or of the joints"
_SIGN = "reverse the sign of the action (scale: -1), or of the joint's position and velocity"
Change = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Rival:
    """A hypothesis beside simple physics.

    Args:
        explained: what it explains.
        plain: what simple physics explains of the same windows.
        findings: what to say if it is the best.
        response: the windows with a simulator under which others are to be compared; None for a fault of the columns.
        enough: share of what is left of one velocity at least that it leaves at most; 1 if evidence is enough.
    """

    explained: Explained
    plain: Explained
    findings: Callable[[], list[Finding]]
    response: Response | None = None
    enough: float = BETTER

    @property
    def is_better(self) -> bool:
        """Whether it explains much more."""
        return self.explained.explains_more(self.plain, self.enough)

    @property
    def leaves(self) -> float:
        """Share of what simple physics leaves that it leaves."""
        return self.explained.share / max(self.plain.share, 1e-12)


def check_model(response: Response, lateness: float = 0.0) -> list[Finding]:
    """Looks for the fault of the columns that explains the log best, if it explains much more than physics do.

    Each hypothesis is fitted together with the simple physics of :func:`~torchrl_h2o.data.audit.physics.explain`, and
    judged in windows that the fit has not used. A gap of the dynamics therefore does not count as a fault.

    Args:
        response: simulated windows.
        lateness: rows by which the velocities are late against their positions, which is no lag of the actions.
    """
    if response.drowned:
        return []
    # where friction or a load takes most of what the motors do, errors are compared with their effect, not the motion
    effect = np.nan_to_num(np.nanmedian(np.abs(response.by_gain.sum(-1)), axis=0))
    response = replace(response, held=np.maximum(effect / response.scale, 1.0))
    plain, found = explain(response), []
    for _ in range(2):  # once more with the rotors that were found
        rivals = _rivals(response, plain, lateness)
        better = [rival for rival in rivals if rival.is_better]
        if not better:
            sharp = _lag_of_events(response)
            return found + (_late(response, sharp, lateness) if sharp >= CLEAR_LAG else _belongs(response, plain))
        least = min(rival.leaves for rival in better)
        best = next(rival for rival in better if rival.leaves < least + ALIKE)
        found += best.findings()
        if best.response is None:
            return found
        plain, response = explain(best.response), best.response
    return found + _belongs(response, plain)


def _belongs(response: Response, plain: Explained) -> list[Finding]:
    """Whether physics predict next to nothing, and not better than that velocities stay."""
    stay = replace(plain, left=response.change / (response.scale * response.held))
    if plain.share <= FOREIGN or plain.evidence(stay) > EVIDENCE:
        return []
    words = (
        f"the simulator leaves {percent(plain.share)} of the accelerations unexplained, with any usual gains, friction "
    )
    words += "and zeros: another robot's log, a model that lacks much (a load), or noise as large as the motion"
    return [Finding("model", "warning", words, None, "check that model and log belong together")]


def _rivals(response: Response, plain: Explained, lateness: float) -> list[Rival]:
    """All hypotheses; those with many simulations only if nothing simpler explains nearly all."""
    few, found = response.for_hypotheses(), []
    left = explain(few)
    if np.ptp(response.log.action, axis=0).any():
        found = [*_gains(response, plain), *_motors(response, plain), *_signs(few, left), *_lags(few, lateness)]
    clear = any(rival.is_better and rival.leaves < CLEAR for rival in found)
    if clear or (plain.shares * response.held).mean() <= LITTLE:
        return found
    turns = list(_turns(few))
    return [
        *found,
        *_columns(few, left),
        *_zeros(response, left, turns),
        *_slips(response, plain, left, turns),
        *_rotors(few, left, response),
    ]


def _leaves(plain: Explained, explained: Explained) -> str:
    shares = percent(plain.share), percent(explained.share)
    return f"the simulator leaves {shares[0]} of the accelerations unexplained, and {shares[1]} if "


def _rotors(few: Response, plain: Explained, response: Response) -> Iterator[Rival]:
    """Heavier rotors.

    Behind a gear, a rotor often weighs more than the link, and many models leave it out (``armature``). Every force
    then moves the joints several times too much in the simulator, which can look like late actions, or like another
    robot's log.
    """
    words = "the simulator agrees with the log far better with rotors on its joints (armature); what follows is "
    note = Finding("model", "note", words + "compared with these", None, "a search will tell their size")
    for share in ROTORS:
        if rotors := _rotor_effects(response, share):
            simulation = response.simulation.with_effects(*rotors)
            heavier, all_windows = (replace(one, simulation=simulation, is_known=False) for one in (few, response))
            yield Rival(explain(heavier), plain, lambda: [note], all_windows)


def _rotor_effects(response: Response, share: float) -> list:
    """A rotor on each hinge and slide joint that has a name, of a share of the joint's inertia in the model."""
    from torchrl_h2o.effects import Armature

    model, rotors = response.simulation.model, []
    for velocity in response.log.velocities:
        joint = int(model.dof_jntid[velocity.dof])
        name = model.joint(joint).name
        if name and int(model.jnt_type[joint]) in (2, 3):  # mjtJoint: slide, hinge
            rotors.append(Armature(share / max(float(model.dof_invweight0[velocity.dof]), 1e-9), name))
    return rotors


def _motors(response: Response, plain: Explained) -> Iterator[Rival]:
    """Gains that no motor has, actions in another order, and actions that belong to another run."""
    log, count = response.log, len(response.log.actuators)
    free, none = explain(response, gains=ANY_GAINS), explain(response, gains=NO_GAINS)
    if none.share < free.share + LITTLE and response.held.max() < HELD:  # no gains help either
        words = f"{_leaves(plain, none)}the actions did nothing: they belong to another run"
        foreign = Finding("actions", "severe", words, None, "pair the log with its own actions")
        yield Rival(none, plain, lambda: [foreign], enough=1.0)
    for one, other in combinations(range(count), 2):
        order = np.arange(count)
        order[[one, other]] = other, one
        explained = explain(response, order=order)
        moved, names = log.moved_by(one), (log.actuators[other], log.actuators[one])
        words = f"{moved} follows the action of {names[0]} instead of {names[1]}: the columns are exchanged"
        yield Rival(explained, plain, lambda words=words: [Finding("actions", "severe", words, None, _ORDER)])


def _signs(response: Response, plain: Explained) -> Iterator[Rival]:
    """Actions with the other sign, simulated."""
    names = response.log.actuators
    for index, name in enumerate(names):
        sign = np.where(np.arange(len(names)) == index, -1.0, 1.0)
        explained = explain(response.driven_by(sign * response.actions))
        words = f"{_leaves(plain, explained)}the action of {name} has the other sign"
        yield Rival(explained, plain, lambda words=words: [Finding("actions", "severe", words, None, _SIGN)])


def _gains(response: Response, plain: Explained) -> Iterator[Rival]:
    """Gains of the actions that are negative, or far from the simulator's, in both fits."""
    findings, (low, high), (far_low, far_high) = [], USUAL_GAINS, UNIT_GAINS
    free = explain(response, gains=ANY_GAINS)
    sizes = np.nanmedian(np.abs(response.by_gain) / (response.scale * response.held)[:, None], axis=0).max(0)
    for name, gains, size in zip(response.log.actuators, free.gains.T, sizes, strict=True):
        gain = float(gains.mean())
        if size < LITTLE:  # what moves nothing in the simulator has no gain
            continue
        if gains.max() < 0.0:
            words = f"{_leaves(plain, free)}the action of {name} has the other sign"
            findings.append(Finding("actions", "severe", words, None, _SIGN))
        elif gains.max() < low or gains.min() > high:
            far = gains.max() < far_low or gains.min() > far_high
            words = f"the accelerations follow {gain:.3g} × the action of {name}: "
            words += "the action looks like another unit" if far else "a weak or strong motor, other masses or units"
            words, remedy = f"{words}, or another robot's log", "compare unit and gear of the action with the model"
            findings.append(Finding("actions", "severe" if far else "warning", words, None, remedy))
    if findings and response.is_known:  # rotors of another size look like another gain
        yield Rival(free, plain, lambda: findings, enough=1.0 if free.gains.max(0).min() < 0.0 else BETTER)


def _lags(few: Response, lateness: float) -> Iterator[Rival]:
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
        yield Rival(found[best], found[0], lambda: said)


def _late_by(lag: int, actions: np.ndarray, runs: Sequence[slice]) -> np.ndarray:
    """Actions some rows later in each run, (T, nu); the first or last ones of a run are repeated at its end."""
    rows = [np.clip(np.arange(run.start, run.stop) - lag, run.start, run.stop - 1) for run in runs]
    return actions[np.concatenate(rows)]


def _lag_of_events(response: Response) -> int:
    """Lag in rows at which sudden changes of the actions and of the accelerations coincide; 0 if it is not clear.

    If actions are smooth, errors of the friction and the masses hide the lag. Second differences of the velocities
    contain little of these errors. The lag must be significant, and the same for differences over one and two rows.
    """
    found = {_lag_of_changes(response, rows) for rows in (1, 2)}
    if len(found) > 1 or not (lag := found.pop()):
        return 0
    actions, known = response.mean_action(lag)
    shares = (explain(response, actions=given, known=known).share for given in (actions, None))
    return lag if operator.lt(*shares) else 0


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
    slope = np.nan_to_num(np.nanmedian(response.by_action, axis=0)) / scale[:, None]
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


def _columns(few: Response, plain: Explained) -> Iterator[Rival]:
    """The columns of positions and velocities in other units, with other signs, exchanged, or relative to the world.

    All are tried with the derivatives of the columns as they are; the best ones again with their own.
    """
    changes = [*_hypotheses(few.log.pairs, few.log.observation), *absolute_angles(few.log.pairs, few.simulation.model)]
    tried = [few.changed(change) for change, _ in changes]
    left = [explain(one).share for one in tried], [one.misfit() for one in tried]
    best = {int(index) for shares in left for index in np.argsort(shares)[:2]}
    for change, words in (changes[index] for index in sorted(best)):
        explained = explain(replace(few.changed(change), like=None))
        words, remedy = _leaves(plain, explained) + words, "correct units, signs or order of the columns"
        fault = Finding("model", "severe", words, None, remedy)
        yield Rival(explained, plain, lambda fault=fault: [fault])


def _hypotheses(pairs: tuple[Pair, ...], observation: np.ndarray) -> Iterator[tuple[Change, str]]:
    """Changes of the observations (..., n), and what each would mean."""
    angles = [pair for pair in pairs if pair.angle]
    degree = np.pi / 180.0
    if angles and observation[:, [pair.position for pair in angles]].std(0).max() > 1.0:
        yield _scaled(angles, degree), "all angles and their velocities are taken as degrees: they look like degrees"
    elif angles:
        yield _scaled(angles, 1.0 / degree), "all angles are 57.3 times larger: they look like rad declared as degrees"
    for pair in angles:
        if len(angles) > 1:
            yield _scaled([pair], degree), f"{pair.name} and its velocity are taken as degrees: they look like degrees"
    for pair in pairs:
        yield _scaled([pair], -1.0), f"{pair.name} and its velocity are reversed: their sign is wrong"
    for one, other in combinations(pairs, 2):
        if one.angle == other.angle:
            yield _exchanged(one, other), f"{one.name} and {other.name} are exchanged, with their velocities"


def _scaled(pairs: list[Pair], factor: float) -> Change:
    columns = [column for pair in pairs for column in (pair.position, pair.velocity)]

    def change(observations: np.ndarray) -> np.ndarray:
        changed = observations.copy()
        changed[..., columns] *= factor
        return changed

    return change


def _exchanged(one: Pair, other: Pair) -> Change:
    first, second = [one.position, one.velocity], [other.position, other.velocity]

    def change(observations: np.ndarray) -> np.ndarray:
        changed = observations.copy()
        changed[..., first], changed[..., second] = observations[..., second], observations[..., first]
        return changed

    return change


def absolute_angles(pairs: tuple[Pair, ...], model: Any) -> Iterator[tuple[Change, str]]:
    """Changes of the observations (..., n) that make angles relative to the parent link, and what each would mean.

    A belt from a motor at the base, or an inertial sensor on a link, gives the angle of a link in the world. Only
    angles about parallel axes differ by a sum, so only joints with such an ancestor are concerned.

    Args:
        pairs: columns of the joints' angles and velocities.
        model: the ``mujoco.MjModel``.
    """
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    above = {pair: found for pair in pairs if (found := _parallel_above(pair, pairs, model, data.xaxis))}
    for pair, parents in above.items():
        words = f"{pair.name} and its velocity are counted from the parent link: they look like the angle of the link "
        others = " and ".join(parent.name for parent, _ in parents)
        yield _relative({pair: parents}), f"{words}in the world, which also contains {others}"
    if len(above) > 1:
        names = ", ".join(pair.name for pair in above)
        words = f"{names} and their velocities are counted from the parent links: they look like the links' angles in "
        yield _relative({pair: parents[:1] for pair, parents in above.items()}), words + "the world"


def _parallel_above(pair: Pair, pairs: tuple[Pair, ...], model: Any, axes: np.ndarray) -> list[tuple[Pair, float]]:
    """The hinges above a hinge whose axes are parallel, the nearest first, with the signs by which angles add up."""
    by_joint = {int(model.dof_jntid[other.dof]): other for other in pairs if other.angle}
    joint, found = int(model.dof_jntid[pair.dof]), []
    if joint not in by_joint:
        return found
    body = int(model.body_parentid[model.jnt_bodyid[joint]])
    while body:
        first = int(model.body_jntadr[body])
        for other in range(first, first + int(model.body_jntnum[body])):
            cosine = float(axes[joint] @ axes[other])
            if other in by_joint and int(model.jnt_type[other]) == 3 and abs(cosine) > PARALLEL:
                found.append((by_joint[other], float(np.sign(cosine))))
        body = int(model.body_parentid[body])
    return found


def _relative(above: dict[Pair, list[tuple[Pair, float]]]) -> Change:
    def change(observations: np.ndarray) -> np.ndarray:
        changed = observations.copy()
        for pair, parents in above.items():
            for parent, sign in parents:
                changed[..., pair.position] -= sign * observations[..., parent.position]
                changed[..., pair.velocity] -= sign * observations[..., parent.velocity]
        return changed

    return change


def _turns(few: Response) -> Iterator[tuple[np.ndarray, Explained]]:
    """Shifts of one angle after another around the circle, (pairs,), and what physics explain with them."""
    pairs = few.log.pairs
    for index in np.flatnonzero([pair.angle for pair in pairs]):
        for shift in 2.0 * np.pi / TURN_STEPS * np.arange(1 - TURN_STEPS // 2, TURN_STEPS // 2 + 1):
            if shift:
                shifts = np.eye(len(pairs))[index] * shift
                yield shifts, explain(few.shifted(shifts))


def _zeros(response: Response, left: Explained, turns: Sequence[tuple[np.ndarray, Explained]]) -> Iterator[Rival]:
    """Angles that are counted from elsewhere than in the model, in all rows."""
    far = Response.of(response.log, response.simulation, response.noise, ZERO_SIGNAL)
    if far is None or not turns:
        return
    far, starts = replace(far, held=response.held), [np.zeros(len(response.log.pairs))]
    shifts, explained = min(turns, key=lambda turn: turn[1].share)
    if explained.share < left.share:
        starts.append(shifts)
    plain = explain(far)
    for start in starts:
        if (shifts := _refined(far, start)).any():
            explained = explain(replace(far.shifted(shifts), like=None))
            said = _shifted(response, plain, explained, shifts)
            severe = any(finding.severity == "severe" for finding in said)
            yield Rival(explained, plain, lambda said=said: said, enough=BETTER if severe else 1.0)


def _refined(response: Response, shifts: np.ndarray) -> np.ndarray:
    """Shifts of the angles, (pairs,), with which simple physics explains most, near given ones; 0 for small ones."""
    angles = np.array([pair.angle for pair in response.log.pairs])
    for _ in range(3):
        explained = explain(replace(response.shifted(shifts), like=None), zeros=np.pi)
        shifts = shifts + np.where(angles, np.clip(explained.zeros.mean(0), -0.5, 0.5), 0.0)
    return np.where(np.abs(shifts) > SMALL_ZERO, np.angle(np.exp(1j * shifts)), 0.0)


def _shifted(response: Response, plain: Explained, explained: Explained, shifts: np.ndarray) -> list[Finding]:
    found = []
    for pair, shift in zip(response.log.pairs, shifts, strict=True):
        if shift:
            half = ", half a turn" if abs(abs(shift) - np.pi) < 0.1 else ""
            words = f"{_leaves(plain, explained)}the zero of {pair.name} is shifted by {-shift:.2f} rad{half}: an "
            words += "offset, a tilted model, or a centre of mass beside the joint's axis"
            severity = "severe" if abs(shift) > 0.5 * np.pi else "warning"  # a load turns a joint by less
            remedy = "measure the angle's zero, for example at rest; if it is wrong, add offset: "
            found.append(Finding("model", severity, words, None, f"{remedy}{shift:.3g} to its column"))
    return found


def _slips(
    response: Response, plain: Explained, left: Explained, turns: Sequence[tuple[np.ndarray, Explained]]
) -> Iterator[Rival]:
    """An angle that is counted from elsewhere in a part of the log, as that of an encoder that loses counts.

    Physics are fitted to the part alone, so a force that begins there is no shift.
    """
    few, best = response.for_hypotheses(), (0.0, slice(0), np.zeros(0))
    for shifts, shifted in turns:
        gained = _by_window(left) - _by_window(shifted) - LITTLE
        best = max(best, (*_highest_sum(gained, few.log.run[few.starts]), shifts), key=lambda found: found[0])
    total, part, shifts = best
    if not total or not SHORTEST_PART <= part.stop - part.start < 0.95 * len(few.starts):
        return
    first, last = few.starts[part.start], few.starts[part.stop - 1]
    inside = (response.starts >= first) & (response.starts <= last)
    own = response.at(inside)
    if len(own.starts) < SHORTEST_PART or not (shifts := _refined(own, shifts)).any():
        return
    without, explained = explain(own), explain(replace(own.shifted(shifts), like=None))
    index = int(np.abs(shifts).argmax())
    rows = np.zeros(len(response.log), bool)
    rows[first : last + response.horizon] = True
    if not explained.explains_more(without):
        return
    words = f"{_leaves(without, explained)}the zero of {response.log.pairs[index].name} is shifted by "
    words += (
        f"{-shifts[index]:.2f} rad in about rows {first} to {last}: its sensor slipped, lost counts, or was set to "
    )
    remedy = "leave these rows out, or correct the column"
    finding = Finding("model", "severe", words + "zero elsewhere", Rows.of(rows), remedy)
    yield Rival(explain(response.shifted(shifts, inside)), plain, lambda: [finding])


def _by_window(explained: Explained) -> np.ndarray:
    """What is left of the changes of the velocities in each window, mean over the velocities, (W,)."""
    return np.minimum(np.nan_to_num(np.abs(explained.left), nan=3.0), 3.0).mean(1)


def _highest_sum(values: np.ndarray, groups: np.ndarray) -> tuple[float, slice]:
    """The highest sum of successive values of one group, and their places (the algorithm of Kadane)."""
    best, total, first = (0.0, slice(0)), 0.0, 0
    for place, value in enumerate(values):
        if total <= 0.0 or groups[place] != groups[place - 1]:
            total, first = 0.0, place
        total += value
        if total > best[0]:
            best = total, slice(first, place + 1)
    return best
