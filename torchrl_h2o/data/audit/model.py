"""Checks that need the simulator: faults of units, signs, order and zeros that leave the columns consistent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from operator import itemgetter
from typing import Any

import numpy as np

from torchrl_h2o.data.audit.actions import reversed_action
from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.regression import (
    BETTER,
    FOREIGN,
    MISFIT,
    friction_dominates,
    percent,
    unexplained,
    unexplained_with_gains,
)
from torchrl_h2o.data.audit.response import MIN_WINDOWS, Response
from torchrl_h2o.data.audit.undriven import check_undriven_zeros
from torchrl_h2o.data.audit.zeros import check_large_zeros, check_small_zeros

CHECK = "model"
REGRESSION_STEPS = 300_000  # physics steps of all regressions at most; robots with too many joints are left out


Change = Callable[[np.ndarray], np.ndarray]
PARALLEL = 0.999  # cosine of the angle between two joints' axes


def check_model(response: Response) -> list[Finding]:
    """Checks whether the simulator fits much better after columns are scaled, reversed, exchanged or shifted."""
    few = response.for_hypotheses()
    misfit = few.misfit()
    if misfit <= MISFIT:
        return check_large_zeros(response)
    best, words = min(BETTER * misfit, FOREIGN), None  # a change that explains nothing is no cause
    for change, what in _hypotheses(few.log.pairs):
        left = few.changed(change).misfit()
        if left < best and misfit - left > 0.1:
            best, words = left, what
    if words is None:
        if wrong_columns := _by_regression(response):
            return wrong_columns
        undriven = check_undriven_zeros(response)
        if any(finding.severity == "severe" for finding in undriven):
            return undriven
        return check_large_zeros(response) or undriven or check_small_zeros(response)
    # a reversed action of one joint can look like a reversed joint
    if any(few.misfit(actions=reversed_action(index)) <= best for index in range(len(few.log.actuators))):
        return []
    explained = f"the simulator leaves {percent(misfit)} of the accelerations unexplained, and {percent(best)} if "
    return [Finding(CHECK, "severe", explained + words, None, "correct units, signs or order of the columns")]


def _by_regression(response: Response) -> list[Finding]:
    """Reversed angles, or angles in the world, with which gains, friction and zeros explain the log.

    Where the simulator lacks friction or a motor has another gain, its error may not tell the signs of its joints. If
    much stays unexplained in any case, it lacks too much to tell: then wrong columns may fit better by chance.
    Reversing one joint is like reversing all others and the actions, so of two explanations, that with positive gains
    is meant.
    """
    few, found = response.for_hypotheses().thinned(MIN_WINDOWS), []
    changes = [*_reversals(few.log.pairs), *absolute_angles(few.log.pairs, few.simulation.model)]
    regressors = len(few.log.actuators) + 2 * len(few.log.pairs)
    steps = few.simulation.frame_skip * few.horizon * len(few.starts)
    if not changes or len(changes) * regressors * steps > REGRESSION_STEPS:
        return []
    plain = unexplained(few)
    for change, what in changes:
        left, gains = unexplained_with_gains(few.changed(change))
        if left < BETTER * plain:
            found.append(((gains < 0.0).sum(), left, what, change))
    if not found:
        return []
    _, _, words, change = min(found, key=itemgetter(0, 1))
    plain, left = unexplained(response), unexplained(response.changed(change))
    if left >= min(MISFIT, BETTER * plain):
        return []
    shares = f"leave {percent(plain)} of the accelerations unexplained, and {percent(left)}"
    remedy = "correct their sign (scale: -1), or subtract the angles and velocities that it also contains"
    return [Finding(CHECK, "severe", f"gains, friction and zeros {shares} if {words}", None, remedy)]


def _hypotheses(pairs: tuple[Pair, ...]) -> Iterator[tuple[Change, str]]:
    """Changes of the observations (..., n), and what each would mean."""
    angles = [pair for pair in pairs if pair.angle]
    degree = np.pi / 180.0
    if angles:
        yield _scaled(angles, degree), "all angles and their velocities are taken as degrees: they look like degrees"
        yield _scaled(angles, 1.0 / degree), "all angles are 57.3 times larger: they look like rad declared as degrees"
    for pair in angles:
        if len(angles) > 1:
            yield _scaled([pair], degree), f"{pair.name} and its velocity are taken as degrees: they look like degrees"
    yield from _reversals(pairs)
    for kind in (True, False):
        alike = [pair for pair in pairs if pair.angle == kind]
        for one, other in combinations(alike, 2):
            words = f"{one.name} and {other.name} are exchanged, with their velocities"
            yield _exchanged(one, other), words


def _reversals(pairs: tuple[Pair, ...]) -> Iterator[tuple[Change, str]]:
    for pair in pairs:
        yield _scaled([pair], -1.0), f"{pair.name} and its velocity are reversed: their sign is wrong"


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


def check_belonging(response: Response) -> list[Finding]:
    """Whether the simulator explains next to nothing, even with other gains, friction and constant forces."""
    if response.drowned:
        return []
    left = unexplained(response)
    if not left > FOREIGN or friction_dominates(response):
        return []
    words = f"the simulator leaves {percent(left)} of the accelerations unexplained, with any "
    words += (
        "gains, friction and zeros: another robot's log, a model that lacks much (rotors, a load), or noise as large "
    )
    words += "as the motion"
    return [Finding(CHECK, "warning", words, None, "check that model and log belong together")]


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
