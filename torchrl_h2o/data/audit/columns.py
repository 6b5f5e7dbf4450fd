"""Hypotheses about the columns of positions and velocities: units, signs, order, angles in the world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.physics import Explained, explain
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.rival import Rival, leaves

PARALLEL = 0.999  # cosine of the angle between two joints' axes
DEGREES = 1.0  # largest standard deviation of the angles, in rad, above which they may be degrees

Change = Callable[[np.ndarray], np.ndarray]


def other_columns(few: Response, plain: Explained) -> Iterator[Rival]:
    """The columns in other units, with other signs, exchanged, or as angles in the world.

    All are tried with the derivatives of the columns as they are; the best ones again with their own.

    Args:
        few: windows, which are simulated for each hypothesis.
        plain: what simple physics explains of them.
    """
    changes = [*_hypotheses(few.log.pairs, few.log.observation), *absolute_angles(few.log.pairs, few.simulation.model)]
    tried = [few.changed(change) for change, _ in changes]
    left = [explain(one).share for one in tried], [one.misfit() for one in tried]
    best = {int(index) for shares in left for index in np.argsort(shares)[:2]}
    for change, words in (changes[index] for index in sorted(best)):
        explained = explain(replace(few.changed(change), like=None))
        words, remedy = leaves(plain, explained) + words, "correct units, signs or order of the columns"
        yield Rival(explained, plain, (Finding("model", "severe", words, None, remedy),))


def _hypotheses(pairs: tuple[Pair, ...], observation: np.ndarray) -> Iterator[tuple[Change, str]]:
    """Changes of the observations (..., n), and what each would mean."""
    angles = [pair for pair in pairs if pair.angle]
    degree = np.pi / 180.0
    if angles and observation[:, [pair.position for pair in angles]].std(0).max() > DEGREES:
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
