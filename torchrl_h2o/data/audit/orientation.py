"""Checks of a free body's quaternion against its angular velocities, and of its velocity against its place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import Log, Turning

CHECK = "kinematics"
QUATERNION_NORM = 0.05  # distance of a quaternion's norm from 1 from which it is none
LOST_NORM = 0.5  # the same distance in few rows: a tracker that has lost the body writes zeros
LOST_QUATERNIONS = 0.001  # share of rows without a quaternion from which they are named
MANY_LOST = 0.15  # the share from which they are severe
EXPLAINED = 1e-3  # share of unexplained rotations or displacements up to which the columns are not doubted
TURNED = 0.2  # share of rotations or displacements that wrong velocities leave unexplained at least
BETTER_ORIENTATION = 0.5  # share of this misfit that another meaning of the columns must leave at most
_SPANS = (1, 2, 4, 8, 16, 32)  # rows over which rotations and displacements are compared with integrals
_LAGS = (1, 2, 3, 4, 6, 8, -1, -2, -3, -4, -6, -8)  # rows by which angular velocities may be late
_SMALL = 0.5  # rad; integrals of angular velocities are compared with rotations up to this angle
_TURNS = 0.05  # rad per row beyond which a body surely turns
_ABOUT = ("x", "y", "z")


def check_orientation(log: Log) -> list[Finding]:
    """Whether quaternions are unit quaternions in the right order, and fit the angular velocities.

    MuJoCo's convention: a quaternion w, x, y, z turns the body's axes into those of its parent, for a free joint the
    world's; angular velocities are in the body's axes, and a free joint's velocity is in the world's.

    Args:
        log: the data.
    """
    found = []
    for body in log.turning:
        faults = _quaternion(log, body)
        if not any(finding.severity == "severe" for finding in faults):
            faults += _angular_velocities(log, body)
            faults += _velocity(log, body)
        found += faults
    return found


def _quaternion(log: Log, body: Turning) -> list[Finding]:
    found, wrong = [], _wrong(log, body, QUATERNION_NORM)
    if wrong.mean() <= MANY_LOST:  # an episode may begin with noise on its quaternion
        wrong = _wrong(log, body, LOST_NORM)
    if wrong.mean() > LOST_QUATERNIONS:
        norm = np.median(np.linalg.norm(log.observation[wrong][:, body.quaternion], axis=1))
        words = (
            f"in {wrong.mean():.1%} of the rows, the four numbers of {body.name} are no unit quaternion: their norm is "
        )
        severity = "severe" if wrong.mean() > MANY_LOST else "warning"
        remedy = "check columns and units, or leave out the rows in which the tracker has lost the body"
        found.append(Finding(CHECK, severity, f"{words}{norm:.3g}", Rows.of(wrong), remedy))
    flips = (log.observation[:, body.quaternion] * log.following[:, body.quaternion]).sum(1) < 0.0
    if flips.any():
        words = f"the quaternion of {body.name} changes its sign, which is the same rotation; the simulator's does not"
        remedy = "reverse the sign of all four numbers from there on"
        found.append(Finding(CHECK, "severe", words, Rows.of(flips), remedy))
    return found


def _wrong(log: Log, body: Turning, distance: float) -> np.ndarray:
    """Transitions before or after which the norm of the four numbers is further from 1 than a distance, (T,)."""
    norms = (np.linalg.norm(rows[:, body.quaternion], axis=1) for rows in (log.observation, log.following))
    return np.any([~(np.abs(norm - 1.0) <= distance) for norm in norms], axis=0)


@dataclass(frozen=True)
class _Meaning:
    """What the columns of a body may mean.

    Args:
        order: places of w, x, y and z among the four columns of the quaternion.
        signs: their signs.
        axes: places of the angular velocities about x, y and z among their three columns.
        factors: their signs, or their unit in rad/s.
        outside: whether the angular velocities are in the axes of the parent or the world, not of the body.
        lag: rows by which they are late.
    """

    order: tuple[int, ...] = (0, 1, 2, 3)
    signs: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    axes: tuple[int, ...] = (0, 1, 2)
    factors: tuple[float, ...] = (1.0, 1.0, 1.0)
    outside: bool = False
    lag: int = 0


def _angular_velocities(log: Log, body: Turning) -> list[Finding]:
    if not body.rates:
        words = f"no angular velocity is given for {body.name}: the simulator alone would have to tell it"
        return [Finding(CHECK, "warning", words, None, "add the columns of its angular velocities, as of a gyroscope")]
    plain = _unexplained_turns(log, body, _Meaning())
    if plain is None or plain < EXPLAINED:
        return []
    best, told = min(BETTER_ORIENTATION * plain, TURNED), None
    for meaning, words, remedy in _meanings(log, body):
        left = _unexplained_turns(log, body, meaning)
        if left is not None and left < best:
            severity = "warning" if meaning.outside and plain <= TURNED else "severe"
            best, told = BETTER_ORIENTATION * left, Finding(CHECK, severity, words, None, remedy)
    if told is not None:
        return [told]
    if plain <= TURNED:
        return []
    if lag := _lag(log, body, plain):
        words = f"the angular velocities of {body.name} are {abs(lag)} rows {'late' if lag > 0 else 'early'} "
        return [Finding(CHECK, "warning", words + "against its quaternion", None, "shift the columns of one of them")]
    words = f"the angular velocities of {body.name} are not the derivative of its quaternion"
    remedy = "check order, signs and units of the columns; it may also be noise, where the body hardly turns"
    return [Finding(CHECK, "warning", words, None, remedy)]


def _meanings(log: Log, body: Turning) -> Iterator[tuple[_Meaning, str, str]]:
    """Other meanings of the columns, each with what to say and to do."""
    name, outside = body.name, "the world" if body.place or body.velocity else "the parent body"
    degree = np.pi / 180.0
    words = f"the angular velocities of {name} look like degrees per second"
    yield _Meaning(factors=(degree, degree, degree)), words, "correct their unit"
    words = f"the angular velocities of {name} are in the axes of {outside}"
    yield _Meaning(outside=True), words, "turn them into the body's axes, in which MuJoCo has them"
    words = f"the quaternion of {name} is in the order x, y, z, w"
    yield _Meaning(order=(3, 0, 1, 2)), words, "assign the columns anew: the last one is the quaternion's w"
    words = f"the quaternion of {name} is inverted: it turns the axes of {outside} into the body's"
    yield _Meaning(signs=(1.0, -1.0, -1.0, -1.0)), words, "reverse its x, y and z (scale: -1)"
    for axes, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        pairs = zip(_ABOUT, (log.names[body.rates[axis]] for axis in axes), signs, strict=True)
        about = ", ".join(f"about {axis} {'minus ' * (sign < 0.0)}{rate}" for axis, rate, sign in pairs)
        words = f"the quaternion of {name} turns as if the angular velocities were {about}"
        yield _Meaning(axes=axes, factors=signs), words, "correct the order and the signs of the columns"


def _lag(log: Log, body: Turning, plain: float) -> int:
    """Rows by which the angular velocities are late, if that explains most of what they leave; else 0."""
    left = {lag: _unexplained_turns(log, body, _Meaning(lag=lag)) for lag in _LAGS}
    share, lag = min(((share, lag) for lag, share in left.items() if share is not None), default=(plain, 0))
    return lag if share < BETTER_ORIENTATION * plain else 0


def _velocity(log: Log, body: Turning) -> list[Finding]:
    """Whether a free body's velocity is in its own axes, as in a robot's odometry."""
    if not body.place or not body.velocity:
        return []
    wrong = _wrong(log, body, QUATERNION_NORM)
    plain, other = (_unexplained_moves(log, body, wrong, turned) for turned in (False, True))
    if plain is None or other is None or plain < EXPLAINED or not other < BETTER_ORIENTATION * plain:
        return []
    words = f"the velocity of {body.name} is in the axes of the body, as odometry gives it"
    remedy = "turn it into the world's axes, in which a free joint of MuJoCo has it"
    return [Finding(CHECK, "severe" if plain > TURNED else "warning", words, None, remedy)]


def _unexplained_turns(log: Log, body: Turning, meaning: _Meaning) -> float | None:
    """Share of the squared rotations that angular velocities leave unexplained, at the best span; None at rest.

    A constant offset of the angular velocities is left out.
    """
    quaternion, rates = np.take(body.quaternion, meaning.order), np.take(body.rates, meaning.axes)
    wrong = _wrong(log, body, QUATERNION_NORM)
    turned = np.array(meaning.factors) * 0.5 * log.dt * (log.observation + log.following)[:, rates]
    integral, left, sizes = _integral(np.roll(turned, -meaning.lag, axis=0)), [], []
    for rows in _SPANS:
        starts = _whole(log, rows, wrong, margin=abs(meaning.lag))
        if len(starts) < 20:
            break
        before = _rotation(log.observation[starts], quaternion, meaning.signs)
        after = _rotation(log.following[starts + rows - 1], quaternion, meaning.signs)
        rotated = (after * before.inv() if meaning.outside else before.inv() * after).as_rotvec()
        size = float(np.median(np.linalg.norm(rotated, axis=1)))
        if size > _SMALL and left:
            break
        left.append(_unexplained(rotated, integral[starts + rows] - integral[starts]))
        sizes.append(size)
    turns = bool(sizes) and (sizes[0] > _TURNS or max(sizes) > 3.0 * sizes[0])
    return min(left) if turns else None


def turning_rates(log: Log, body: Turning, part: slice, rows: int) -> np.ndarray:
    """Mean angular velocities over some rows from the quaternion, in the body's axes and rad/s, (N - rows, 3)."""
    values = log.observation[part]
    before, after = _rotation(values[:-rows], body.quaternion), _rotation(values[rows:], body.quaternion)
    return (before.inv() * after).as_rotvec() / (rows * log.dt)


def _unexplained_moves(log: Log, body: Turning, wrong: np.ndarray, turned: bool) -> float | None:
    """The same share of the displacements that a velocity leaves unexplained, as it is or turned by the quaternion."""
    velocity = 0.5 * log.dt * (log.observation + log.following)[:, body.velocity]
    if turned:
        velocity[~wrong] = _rotation(log.observation[~wrong], body.quaternion).apply(velocity[~wrong])
    integral, left = _integral(velocity), []
    for rows in _SPANS:
        starts = _whole(log, rows, wrong)
        if len(starts) >= 20:
            moved = log.following[starts + rows - 1][:, body.place] - log.observation[starts][:, body.place]
            left.append(_unexplained(moved, integral[starts + rows] - integral[starts]))
    return min(left, default=None)


def _whole(log: Log, rows: int, wrong: np.ndarray, margin: int = 0) -> np.ndarray:
    """First rows of windows of one run without wrong quaternions, (W,)."""
    starts, bad = log.starts(rows, 2000, margin), np.concatenate([[0], np.cumsum(wrong)])
    return starts[bad[starts + rows] == bad[starts]]


def _rotation(rows: np.ndarray, columns: Sequence[int] | np.ndarray, signs: Sequence[float] = (1.0,) * 4) -> Rotation:
    return Rotation.from_quat(rows[:, columns] * np.array(signs), scalar_first=True)


def _integral(steps: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(steps), axis=0)])


def _unexplained(measured: np.ndarray, integral: np.ndarray) -> float:
    """Median squared difference of two vectors (W, 3) without its offset, over the median square of the measured."""
    difference = measured - integral
    difference = difference - np.median(difference, axis=0)
    difference, size = ((vectors**2).sum(1) for vectors in (difference, measured))
    return float(np.median(difference) / max(np.median(size), 1e-300))
