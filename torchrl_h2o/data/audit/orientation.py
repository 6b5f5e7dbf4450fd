"""Checks of a free body's quaternion against its angular velocities, and of its velocity against its place."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import Log, Turning
from torchrl_h2o.data.audit.settings import AuditSettings

CHECK = "kinematics"
_SPANS = (1, 2, 4, 8, 16, 32)  # rows over which rotations and displacements are compared with integrals
_SMALL = 0.5  # rad; integrals of angular velocities are compared with rotations up to this angle
_ABOUT = ("x", "y", "z")
_ORDER = (
    "the quaternion of {name} is in the order x, y, z, w",
    "assign the columns anew: the last one is the quaternion's w",
)
_INVERSE = (
    "the quaternion of {name} is inverted: it turns the world's axes into the body's",
    "reverse its x, y and z (scale: -1)",
)
_WORLD = (
    "the angular velocities of {name} are in the axes of the world",
    "turn them into the body's axes, in which a free joint of MuJoCo has them",
)
_DEGREES = ("the angular velocities of {name} look like degrees per second", "correct their unit")


def check_orientation(log: Log, settings: AuditSettings) -> list[Finding]:
    """Whether quaternions are unit quaternions in the right order, and fit the angular velocities.

    MuJoCo's convention: a quaternion w, x, y, z turns the body's axes into the world's; angular velocities are in the
    body's axes, and a free joint's velocity is in the world's.

    Args:
        log: the data.
        settings: thresholds.
    """
    found = []
    for body in log.turning:
        faults = _quaternion(log, body, settings)
        if not faults:
            faults = _angular_velocities(log, body, settings)
        found += faults or _velocity(log, body, settings)
    return found


def _quaternion(log: Log, body: Turning, settings: AuditSettings) -> list[Finding]:
    quaternion = log.observation[:, body.quaternion]
    wrong = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > settings.quaternion_norm
    if wrong.mean() > 0.5:
        words = f"the four numbers of {body.name} are no unit quaternion: their norm is "
        words += f"{np.median(np.linalg.norm(quaternion, axis=1)):.3g}"
        return [Finding(CHECK, "severe", words, Rows.of(wrong, settings.examples), "check columns and units")]
    following = log.following[:, body.quaternion]
    flips = (quaternion * following).sum(1) < 0.0
    if not flips.any():
        return []
    words = f"the quaternion of {body.name} changes its sign, which is the same rotation; the simulator's does not"
    remedy = "reverse the sign of all four numbers from there on"
    return [Finding(CHECK, "severe", words, Rows.of(flips, settings.examples), remedy)]


def _angular_velocities(log: Log, body: Turning, settings: AuditSettings) -> list[Finding]:
    if not body.rates:
        return []
    quaternion, rates = _rows(log, body.quaternion), _rows(log, body.rates)
    plain = _misfits(log, Rotation.from_quat(quaternion, scalar_first=True), rates)
    if plain is None:
        return []
    best, told = min(settings.better_orientation * plain, settings.turned), None
    for turned, measured, in_world, words, remedy in _hypotheses(log, body, quaternion, rates):
        left = _misfits(log, turned, measured, in_world)
        if left is not None and left < best:
            severity = "warning" if in_world and plain <= settings.turned else "severe"
            best, told = settings.better_orientation * left, (severity, words.format(name=body.name), remedy)
    if told is not None:
        severity, words, remedy = told
        return [Finding(CHECK, severity, words, None, remedy)]
    if plain <= settings.turned:
        return []
    words = f"the angular velocities of {body.name} are not the derivative of its quaternion"
    return [Finding(CHECK, "severe", words, None, "check order, signs and units of the columns")]


def _hypotheses(
    log: Log, body: Turning, quaternion: np.ndarray, rates: np.ndarray
) -> Iterator[tuple[Rotation, np.ndarray, bool, str, str]]:
    """Other meanings of the columns: rotations, angular velocities, whether these are in the world's axes, words."""
    plain = Rotation.from_quat(quaternion, scalar_first=True)
    yield plain, rates * np.pi / 180.0, False, *_DEGREES
    yield plain, rates, True, *_WORLD
    yield Rotation.from_quat(quaternion, scalar_first=False), rates, False, *_ORDER
    yield plain.inv(), rates, False, *_INVERSE
    for axes, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        names = [log.names[body.rates[axis]] for axis in axes]
        pairs = zip(_ABOUT, names, signs, strict=True)
        about = ", ".join(f"about {axis} {'minus ' * (sign < 0.0)}{name}" for axis, name, sign in pairs)
        words = "the quaternion of {name} turns as if the angular velocities were " + about
        yield plain, rates[:, axes] * np.array(signs), False, words, "correct the order and the signs of the columns"


def _velocity(log: Log, body: Turning, settings: AuditSettings) -> list[Finding]:
    """Whether a free body's velocity is in its own axes, as in a robot's odometry."""
    if not body.place or not body.velocity:
        return []
    velocity = _rows(log, body.velocity)
    turned = Rotation.from_quat(_rows(log, body.quaternion), scalar_first=True).apply(velocity)
    plain, other = (_moved(log, _rows(log, body.place), each) for each in (velocity, turned))
    if plain is None or other is None or not other < settings.better_orientation * plain:
        return []
    words = f"the velocity of {body.name} is in the axes of the body, as odometry gives it"
    remedy = "turn it into the world's axes, in which a free joint of MuJoCo has it"
    return [Finding(CHECK, "severe" if plain > settings.turned else "warning", words, None, remedy)]


def _rows(log: Log, columns: tuple[int, ...]) -> np.ndarray:
    """Some columns of all rows and of the last transition's end, (T + 1, k)."""
    return np.vstack([log.observation[:, columns], log.following[-1:, columns]])


def _misfits(log: Log, turned: Rotation, rates: np.ndarray, in_world: bool = False) -> float | None:
    """Share of the squared rotations that angular velocities leave unexplained, at the best span; None at rest."""
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * log.dt * (rates[1:] + rates[:-1]), axis=0)])
    left, sizes = [], []
    for rows in _SPANS:
        starts = log.starts(rows, 2000)
        if len(starts) < 20:
            break
        before, after = turned[starts], turned[starts + rows]
        rotated = (after * before.inv() if in_world else before.inv() * after).as_rotvec()
        size = float(np.median(np.linalg.norm(rotated, axis=1)))
        if size > _SMALL and left:
            break
        left.append(_unexplained(rotated, integral[starts + rows] - integral[starts]))
        sizes.append(size)
    return min(left) if left and max(sizes) > 3.0 * sizes[0] else None


def _moved(log: Log, place: np.ndarray, velocity: np.ndarray) -> float | None:
    """The same share of the displacements that a velocity leaves unexplained."""
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * log.dt * (velocity[1:] + velocity[:-1]), axis=0)])
    left = []
    for rows in _SPANS:
        starts = log.starts(rows, 2000)
        if len(starts) >= 20:
            left.append(_unexplained(place[starts + rows] - place[starts], integral[starts + rows] - integral[starts]))
    return min(left, default=None)


def _unexplained(measured: np.ndarray, integral: np.ndarray) -> float:
    """Median squared difference of two vectors (W, 3), over the median square of the measured ones."""
    difference, size = ((vectors**2).sum(1) for vectors in (measured - integral, measured))
    return float(np.median(difference) / max(np.median(size), 1e-300))
