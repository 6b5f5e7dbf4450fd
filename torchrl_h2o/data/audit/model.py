"""Checks that need the simulator: faults of units, signs, order and zeros that leave the columns consistent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np

from torchrl_h2o.data.audit.actions import friction_dominates, friction_responses, reversed_action
from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.regression import robust_fit
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.settings import AuditSettings

CHECK = "model"
Change = Callable[[np.ndarray], np.ndarray]


def check_model(response: Response, settings: AuditSettings) -> list[Finding]:
    """Checks whether the simulator fits the data much better after columns are scaled, reversed, exchanged or shifted.

    Args:
        response: simulated windows.
        settings: thresholds.
    """
    few = response.for_hypotheses()
    misfit = few.misfit()
    if misfit <= settings.misfit:
        return []
    best, words = min(settings.better * misfit, settings.foreign), None  # a change that explains nothing is no cause
    for change, what in _hypotheses(few.log.pairs):
        left = few.misfit(observations=change)
        if left < best and misfit - left > 0.1:
            best, words = left, what
    if words is None:
        return _zeros(response, settings)
    # a reversed action of one joint can look like a reversed joint
    if any(few.misfit(actions=reversed_action(index)) <= best for index in range(len(few.log.actuators))):
        return []
    explained = f"the simulator leaves {_percent(misfit)} of the accelerations unexplained, and {_percent(best)} if "
    return [Finding(CHECK, "severe", explained + words, None, "correct units, signs or order of the columns")]


def _percent(share: float) -> str:
    return "all" if share >= 0.995 else f"{share:.0%}"


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
    for pair in pairs:
        yield _scaled([pair], -1.0), f"{pair.name} and its velocity are reversed: their sign is wrong"
    for kind in (True, False):
        alike = [pair for pair in pairs if pair.angle == kind]
        for one, other in combinations(alike, 2):
            words = f"{one.name} and {other.name} are exchanged, with their velocities"
            yield _exchanged(one, other), words


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


def _zeros(response: Response, settings: AuditSettings) -> list[Finding]:
    """Angles whose zero is shifted: fitted beside gains and friction, then confirmed by simulation."""
    pairs = response.log.pairs
    angles = [index for index, pair in enumerate(pairs) if pair.angle]
    if not angles:
        return []
    others = friction_responses(response)[..., : 2 * len(pairs)]
    gains = response.by_action * response.limited[response.rows].mean(1)[:, None]
    responses = np.concatenate([response.by_zero[..., angles], gains, others], -1)
    found = robust_fit(response.target, responses, response.scale, settings.robust)
    findings = []
    misfit = response.misfit()
    for place, index in enumerate(angles):
        shift, error = found.values[place], found.errors[place]
        if abs(shift) < max(settings.zero_warning, settings.significance * error) or abs(shift) > np.pi:
            continue
        pair = pairs[index]

        def change(observations: np.ndarray, pair: Pair = pair, shift: float = shift) -> np.ndarray:
            changed = observations.copy()
            changed[..., pair.position] += shift
            return changed

        left = response.misfit(observations=change)
        if left < settings.zero_better * misfit:
            words = f"the simulator leaves {_percent(misfit)} of the accelerations unexplained, and {_percent(left)} "
            words += f"if the zero of {pair.name} is shifted by {-shift:.2f} rad: an offset, or a tilted model"
            findings.append(Finding(CHECK, "warning", words, None, "measure the angle's zero, for example at rest"))
    return findings


def check_belonging(response: Response, settings: AuditSettings) -> list[Finding]:
    """Whether the simulator explains next to nothing, even with other gains, friction and constant forces."""
    if response.drowned:
        return []
    gains = response.by_action * response.limited[response.rows].mean(1)[:, None]
    responses = np.concatenate([gains, friction_responses(response), response.by_zero], -1)
    found = robust_fit(response.target, responses, response.scale, settings.robust)
    left = np.nanmedian(np.abs(response.target - responses @ found.values), axis=0) / response.scale
    if not np.mean(left) > settings.foreign or friction_dominates(response, settings):
        return []
    words = (
        f"the simulator leaves {_percent(float(min(np.mean(left), 1.0)))} of the accelerations unexplained, with any "
    )
    words += "gains, friction and zeros: another robot's log, or noise as large as the motion"
    return [Finding(CHECK, "warning", words, None, "check that model and log belong together")]
