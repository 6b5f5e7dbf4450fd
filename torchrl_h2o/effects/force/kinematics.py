"""Velocities of bodies for many positions of a model at once; MuJoCo's own functions take one position at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

_FREE, _BALL, _SLIDE, _HINGE = (int(kind) for kind in mujoco.mjtJoint.__members__.values())


@dataclass(frozen=True)
class _Motion:
    """How some degrees of freedom move what is attached to them.

    Args:
        dofs: their indices.
        axes: (B, 3, number of dofs), world directions of translation, or axes of rotation.
        anchor: (B, 3), a point of the axes of rotation; None for a translation.
    """

    dofs: slice
    axes: np.ndarray
    anchor: np.ndarray | None

    def moves(self, point: np.ndarray) -> np.ndarray:
        """Velocity of a point (B, 3) per velocity of each degree of freedom, (B, 3, number of dofs)."""
        if self.anchor is None:
            return self.axes
        return np.cross(self.axes, (point - self.anchor)[:, :, None], axis=1)


def com_jacobians(model: mujoco.MjModel, bodies: Iterable[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Returns the derivatives of bodies' velocities by the velocities of all degrees of freedom, for many positions.

    They are equal to those of ``mujoco.mj_jacBodyCom``, of the velocity of a body's centre of mass.

    Args:
        model: the model.
        bodies: indices of N bodies.

    Returns:
        A function from positions, (B, nq), to the derivatives, (B, N, 3, nv).
    """
    wanted = list(bodies)
    chain = [(body, int(model.body_parentid[body])) for body in _with_ancestors(model, wanted)]
    turned = {body: _matrices(model.body_quat[body][None])[0] for body, _ in chain}

    def jacobians(qpos: np.ndarray) -> np.ndarray:
        found = np.zeros((len(qpos), len(wanted), 3, model.nv))
        poses = {0: (np.zeros((len(qpos), 3)), _repeated(np.eye(3), len(qpos)))}
        motions: dict[int, list[_Motion]] = {0: []}
        for body, parent in chain:
            place, turn = poses[parent]
            place, turn = place + turn @ model.body_pos[body], turn @ turned[body]
            place, turn, own = _jointed(model, body, place, turn, qpos)
            poses[body], motions[body] = (place, turn), [*motions[parent], *own]
            centre = place + turn @ model.body_ipos[body]
            for index in (i for i, other in enumerate(wanted) if other == body):
                for motion in motions[body]:
                    found[:, index, :, motion.dofs] = motion.moves(centre)
        return found

    return jacobians


def _with_ancestors(model: mujoco.MjModel, bodies: Sequence[int]) -> list[int]:
    """The bodies and their ancestors without the world, parents first."""
    found: set[int] = set()
    for body in bodies:
        while body and body not in found:
            found.add(int(body))
            body = int(model.body_parentid[body])
    return sorted(found)


def _jointed(
    model: mujoco.MjModel, body: int, place: np.ndarray, turn: np.ndarray, qpos: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[_Motion]]:
    """Place (B, 3) and orientation (B, 3, 3) of a body after its joints have moved it, and the joints' motions."""
    motions = []
    first = int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        kind, at, dof = int(model.jnt_type[joint]), int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        axis, offset = model.jnt_axis[joint], model.jnt_pos[joint]
        moved = qpos[:, at] - model.qpos0[at]
        if kind == _SLIDE:
            direction = turn @ axis
            place = place + direction * moved[:, None]
            motions.append(_Motion(slice(dof, dof + 1), direction[:, :, None], None))
        elif kind == _HINGE:
            anchor, direction = place + turn @ offset, turn @ axis
            turn = turn @ _rotations(axis, moved)
            place = anchor - turn @ offset
            motions.append(_Motion(slice(dof, dof + 1), direction[:, :, None], anchor))
        elif kind == _BALL:
            anchor = place + turn @ offset
            turn = turn @ _matrices(qpos[:, at : at + 4])
            place = anchor - turn @ offset
            motions.append(_Motion(slice(dof, dof + 3), turn, anchor))
        elif kind == _FREE:
            place, turn = qpos[:, at : at + 3], _matrices(qpos[:, at + 3 : at + 7])
            motions.append(_Motion(slice(dof, dof + 3), _repeated(np.eye(3), len(qpos)), None))
            motions.append(_Motion(slice(dof + 3, dof + 6), turn, place))
    return place, turn, motions


def _rotations(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices (B, 3, 3) about a unit axis (3) by angles (B) in rad."""
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (B, 3, 3) of quaternions (B, 4), which are normalised first."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def _repeated(matrix: np.ndarray, times: int) -> np.ndarray:
    return np.broadcast_to(matrix, (times, *matrix.shape))
