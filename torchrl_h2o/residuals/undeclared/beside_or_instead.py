"""Adds a force outside the catalogue to an explanation, beside the catalogue's effects or instead of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, ResidualForce
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.residuals.explanation import Explanation, Part
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise, stand_in
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.problem import Problem, matters
from torchrl_h2o.residuals.trace.significance import p_value_of_losses
from torchrl_h2o.residuals.undeclared.by_catalogue import by_catalogue
from torchrl_h2o.residuals.undeclared.find_force import FURTHER_STEPS, Undeclared, find_undeclared
from torchrl_h2o.residuals.undeclared.needed import MIN_GAIN_OVER_CATALOGUE, needed_parts

MIN_SHARE = 0.01  # share of the whole reduction of the loss that the force must contribute
BEYOND_NOISE = 2.0  # required multiple of the gain of a force found in synthetic data with sensor noise only

Parts = tuple[Part, ...]


@dataclass(frozen=True, eq=False)
class _Candidate:
    """An explanation that contains a force outside the catalogue.

    Args:
        parts: the force, alone or after effects of the catalogue.
        force: the force as it was found.
        base: simulation in which it was found.
    """

    parts: Parts
    force: Undeclared
    base: Simulation


def add_undeclared_force(
    simulation: Simulation,
    measured: Measured,
    explanation: Explanation,
    *,
    rng: np.random.Generator,
    catalogue: Sequence[CatalogueEntry] = (),
    settings: LoopSettings = DEFAULTS,
) -> Explanation:
    """Adds a force outside the catalogue if it improves the explanation.

    The force is searched for beside the effects found, and instead of them, because a force alone may fit the data
    better than the catalogue's effects. Both candidates are judged on held-out data against the present explanation.
    A force whose terms are all effects of the catalogue is replaced by these; see :func:`by_catalogue`.

    Args:
        simulation: the simulator without the effects found.
        measured: the data.
        explanation: effects of the catalogue.
        rng: generator of synthetic noise.
        catalogue: effects that the simulator may lack.
        settings: thresholds and budgets.

    Returns:
        The explanation, unchanged if no force passes the tests, if nothing is left to explain, or if the torques are so
        noisy that the effects come from the missing forces: a force that is fitted to the motion would fit the noise.
    """
    if explanation.trace.exact or explanation.trace.by_forces:
        return explanation
    parts, horizon = explanation.parts, _horizon(explanation)
    first = Problem.pose(simulation, measured, horizon)
    nothing, present = (first.selection_loss(effects) for effects in ((), explanation.effects))
    if not matters(nothing, present, 0.0, MIN_SHARE):
        return explanation  # not even a force that left no residual would be added
    candidates = _candidates(simulation, measured, explanation, settings)
    if not candidates:
        return explanation
    compared = [parts, *(candidate.parts for candidate in candidates)]
    problem = _with_least_noise(simulation, measured, compared, horizon)
    before = problem.selection_losses(_effects_of(parts))
    paying = []
    for candidate in candidates:
        after = problem.selection_losses(_effects_of(candidate.parts))
        pays = _pays(first, before, after, parts, candidate.parts, settings)
        if pays and _beyond_noise(candidate, measured, horizon, rng, settings):
            paying.append((candidate.parts, after.mean()))
    if not paying:
        return explanation
    with_force = _shortest(paying)
    chosen = by_catalogue(problem, with_force, catalogue, settings)
    if not _pays(first, before, problem.selection_losses(_effects_of(chosen)), parts, chosen, settings):
        chosen = with_force
    entries = [entry_of(part.effect, catalogue) for part in chosen if part.declared]
    found = {entry.name for entry in entries if entry is not None}
    attempts = tuple(attempt for attempt in explanation.trace.attempts if attempt.entry.name not in found)
    # other sets of the catalogue's effects explain less than a force beside or instead of these effects
    return replace(explanation, parts=chosen, trace=replace(explanation.trace, attempts=attempts, others=()))


def _horizon(explanation: Explanation) -> int:
    """Control steps per window on which a force is fitted and judged: one, or those of the search if it needs many.

    Where the search needs long windows, the noise of the sensors hides a force one step ahead.
    """
    horizon = explanation.trace.horizon
    return horizon if horizon > FURTHER_STEPS else 1


def _candidates(
    simulation: Simulation, measured: Measured, explanation: Explanation, settings: LoopSettings
) -> list[_Candidate]:
    """Candidates with a force beside the effects found and with a force instead of them, as far as forces are found."""
    parts, candidates, horizon = explanation.parts, [], _horizon(explanation)
    mended = simulation.with_effects(*explanation.effects)
    if (beside := find_undeclared(mended, measured, horizon, settings=settings)) is not None:
        together = _beside(simulation, measured, explanation, beside, settings)
        candidates.append(_Candidate(together, beside, mended))
    # tried even if there is no force beside, because effects that imitate a force may leave a residual like noise
    if parts and (alone := find_undeclared(simulation, measured, horizon, settings=settings)) is not None:
        candidates.append(_Candidate((Part(alone.effect, False, alone.ci95),), alone, simulation))
    return candidates


def _beside(
    simulation: Simulation, measured: Measured, explanation: Explanation, force: Undeclared, settings: LoopSettings
) -> Parts:
    """The effects that are needed beside a force, and the force from a new search beside these effects."""
    parts, horizon = explanation.parts, _horizon(explanation)
    candidate = (*parts, Part(force.effect, False, force.ci95))
    if not parts:
        return candidate
    mended = simulation.with_effects(*_effects_of(parts))
    posed = Problem.pose(mended, measured, horizon)
    needed = needed_parts(replace(posed, simulation=simulation), explanation.trace, candidate, settings)
    known = needed[:-1]
    again = find_undeclared(
        simulation.with_effects(*_effects_of(known)), measured, horizon, settings=settings
    )  # the new search omits terms that have become redundant
    return needed if again is None else (*known, Part(again.effect, False, again.ci95))


def _with_least_noise(
    simulation: Simulation, measured: Measured, explanations: Sequence[Parts], horizon: int
) -> Problem:
    """The problem in which explanations are compared, posed with the explanation that leaves the least sensor noise.

    What one explanation treats as sensor noise, another may explain as a force. Start states that are filtered with the
    first explanation would favour it.
    """
    mended = [simulation.with_effects(*_effects_of(parts)) for parts in explanations]
    spread = np.maximum(measured.observation.std(0), 1e-12)

    def noise(candidate: Simulation) -> float:
        std = sensor_noise(candidate, measured)
        return 0.0 if std is None else float(((std / spread) ** 2).mean())

    posed = Problem.pose(min(mended, key=noise), measured, horizon)
    return replace(posed, simulation=simulation)


def _effects_of(parts: Parts) -> list[Effect]:
    return [part.effect for part in parts]


def _pays(
    first: Problem, before: np.ndarray, after: np.ndarray, parts: Parts, candidate: Parts, settings: LoopSettings
) -> bool:
    """Whether a candidate lowers the held-out loss enough, significantly, and by a share of the whole reduction."""
    gains = after.mean() < (1.0 - MIN_GAIN_OVER_CATALOGUE) * before.mean()
    if not (gains and p_value_of_losses(before, after, settings) < settings.level):
        return False
    none, present, proposed = (first.selection_loss(_effects_of(some)) for some in ((), parts, candidate))
    return matters(none, present, proposed, MIN_SHARE)


def _beyond_noise(
    candidate: _Candidate, measured: Measured, horizon: int, rng: np.random.Generator, settings: LoopSettings
) -> bool:
    """Whether the force explains more than one found in data with sensor noise as the only difference."""
    sensor_std = sensor_noise(candidate.base, measured)
    if sensor_std is None:
        return True
    data = stand_in(candidate.base, measured, sensor_std, rng, horizon)
    by_chance = find_undeclared(candidate.base, data, horizon, settings=settings)
    if by_chance is None:
        return True
    return _explained(candidate.force) > BEYOND_NOISE * _explained(by_chance)


def _explained(force: Undeclared) -> float:
    """Share of the held-out error that a force removes, mean over the dimensions."""
    return float(np.mean(1.0 - force.error_after / np.maximum(force.error_before, 1e-300)))


def _shortest(paying: Sequence[tuple[Parts, float]]) -> Parts:
    """The shortest explanation whose loss is close to the lowest; on a tie, the one with the catalogue's effects."""
    least = min(loss for _, loss in paying)
    limit = least / (1.0 - MIN_GAIN_OVER_CATALOGUE)
    return min((parts for parts, loss in paying if loss <= limit), key=_description_length)


def _description_length(parts: Parts) -> int:
    """Description length: one per effect of the catalogue, one per term of a force."""
    return sum(1 if part.declared else len(cast("ResidualForce", part.effect).terms) for part in parts)
