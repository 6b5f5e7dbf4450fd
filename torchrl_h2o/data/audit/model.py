"""Checks that need the simulator: faults of units, signs, order and zeros that leave the columns consistent."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from operator import itemgetter

import numpy as np

from torchrl_h2o.data.audit.absolute import Change, absolute_angles
from torchrl_h2o.data.audit.actions import friction_dominates, reversed_action
from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings
from torchrl_h2o.data.audit.undriven import check_undriven_zeros
from torchrl_h2o.data.audit.unexplained import percent, unexplained, unexplained_and_reversed
from torchrl_h2o.data.audit.zeros import check_large_zeros, check_small_zeros

CHECK = "model"


def check_model(response: Response, settings: AuditSettings) -> list[Finding]:
    """Checks whether the simulator fits the data much better after columns are scaled, reversed, exchanged or shifted.

    Args:
        response: simulated windows.
        settings: thresholds.
    """
    few = response.for_hypotheses()
    misfit = few.misfit()
    if misfit <= settings.misfit:
        return check_large_zeros(response, settings)
    best, words = min(settings.better * misfit, settings.foreign), None  # a change that explains nothing is no cause
    for change, what in _hypotheses(few.log.pairs):
        left = few.misfit(observations=change)
        if left < best and misfit - left > 0.1:
            best, words = left, what
    if words is None:
        if wrong_columns := _by_regression(response, settings):
            return wrong_columns
        undriven = check_undriven_zeros(response, settings)
        if any(finding.severity == "severe" for finding in undriven):
            return undriven
        return check_large_zeros(response, settings) or undriven or check_small_zeros(response, settings)
    # a reversed action of one joint can look like a reversed joint
    if any(few.misfit(actions=reversed_action(index)) <= best for index in range(len(few.log.actuators))):
        return []
    explained = f"the simulator leaves {percent(misfit)} of the accelerations unexplained, and {percent(best)} if "
    return [Finding(CHECK, "severe", explained + words, None, "correct units, signs or order of the columns")]


def _by_regression(response: Response, settings: AuditSettings) -> list[Finding]:
    """Reversed angles, or angles in the world, with which gains, friction and zeros explain the log.

    Where the simulator lacks friction or a motor has another gain, its error may not tell the signs of its joints. If
    much stays unexplained in any case, it lacks too much to tell: then wrong columns may fit better by chance.
    Reversing one joint is like reversing all others and the actions, so of two explanations, that with positive gains
    is meant.
    """
    few, found = response.for_hypotheses().thinned(settings.min_windows), []
    changes = [*_reversals(few.log.pairs), *absolute_angles(few.log.pairs, few.simulation.model)]
    regressors = len(few.log.actuators) + 2 * len(few.log.pairs)
    steps = few.simulation.frame_skip * few.horizon * len(few.starts)
    if not changes or len(changes) * regressors * steps > settings.regression_steps:
        return []
    plain = unexplained(few, settings)
    for change, what in changes:
        left, negative = unexplained_and_reversed(few.changed(change), settings)
        if left < settings.better * plain:
            found.append((negative, left, what, change))
    if not found:
        return []
    _, _, words, change = min(found, key=itemgetter(0, 1))
    plain, left = unexplained(response, settings), unexplained(response.changed(change), settings)
    if left >= min(settings.misfit, settings.better * plain):
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


def check_belonging(response: Response, settings: AuditSettings) -> list[Finding]:
    """Whether the simulator explains next to nothing, even with other gains, friction and constant forces."""
    if response.drowned:
        return []
    left = unexplained(response, settings)
    if not left > settings.foreign or friction_dominates(response, settings):
        return []
    words = f"the simulator leaves {percent(left)} of the accelerations unexplained, with any "
    words += (
        "gains, friction and zeros: another robot's log, a model that lacks much (rotors, a load), or noise as large "
    )
    words += "as the motion"
    return [Finding(CHECK, "warning", words, None, "check that model and log belong together")]
