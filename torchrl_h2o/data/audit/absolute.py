"""Angles that are counted from the world, or from the base, where the model counts them from the parent link."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from torchrl_h2o.data.audit.log import Pair

Change = Callable[[np.ndarray], np.ndarray]
_PARALLEL = 0.999  # cosine of the angle between two joints' axes
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)


def absolute_angles(pairs: tuple[Pair, ...], model: Any) -> Iterator[tuple[Change, str]]:
    """Changes of the observations (..., n) that make angles relative to the parent link, and what each would mean.

    A belt from a motor at the base, or an inertial sensor on a link, gives the angle of a link in the world. Only
    angles about parallel axes differ by a sum, so only joints with such an ancestor are concerned.

    Args:
        pairs: columns of the joints' angles and velocities.
        model: the ``mujoco.MjModel``.
    """
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
            if other in by_joint and int(model.jnt_type[other]) == _HINGE and abs(cosine) > _PARALLEL:
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
