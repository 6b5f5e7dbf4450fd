"""What explains a residual: effects of a catalogue, a force that nobody declared, and noise of the action."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from torchrl_h2o.effects import ActionNoise, CatalogueEntry, Effect
from torchrl_h2o.residuals.measured.chance import sensor_noise, stand_in
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.action_noise import estimate_noise
from torchrl_h2o.residuals.trace.fit import fit
from torchrl_h2o.residuals.trace.problem import Problem, losses, matters
from torchrl_h2o.residuals.trace.screening import free_parameters
from torchrl_h2o.residuals.trace.search import trace_effects
from torchrl_h2o.residuals.trace.significance import p_value_of_losses
from torchrl_h2o.residuals.trace.trace import Trace
from torchrl_h2o.residuals.undeclared.undeclared import Undeclared, find_undeclared

_LEVEL = 0.01
_PAYS = 0.05  # share of the held-out loss that a force which nobody declared must take away
_WORTH_A_WORD = 0.01  # of all that is explained
_BEYOND_NOISE = 2.0  # times what such a force explains where there is nothing but noise
_NOISE_CHANGE = 0.1  # of the simulator's own action noise: less is not worth a word


@dataclass(frozen=True, eq=False)
class Part:
    """An effect that explains a part of the residual.

    Args:
        effect: with its values.
        declared: whether it is an entry of the catalogue.
        ci95: the 95 % interval of each parameter that was fitted.
        alike: other effects that do as well in its place.
    """

    effect: Effect
    declared: bool
    ci95: Mapping[str, tuple[float, float]]
    alike: tuple[Effect, ...] = ()


@dataclass(frozen=True, eq=False)
class Explanation:
    """What explains a residual, in the order in which it was put in, and the search that it came from."""

    parts: tuple[Part, ...]
    trace: Trace

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects alone."""
        return tuple(part.effect for part in self.parts)


def explain(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    *,
    rng: np.random.Generator,
    progress: tqdm,
) -> Explanation:
    """Explains the residual between data and a simulation.

    Effects of the catalogue come first. Where they leave something, a force made from the residual may stand beside
    them, or in their place: what fits the data better by itself is not called by the names of others.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: the effects that it could lack.
        rng: draws windows and noise.
        progress: shows how far the search is.

    Returns:
        The explanation, without any parts if nothing is missing.
    """
    trace = trace_effects(simulation, measured, catalogue, rng=rng, progress=progress)
    parts = [
        Part(effect, True, trace.fit.ci95(index), tuple(attempt.effect for attempt in trace.groups[index]))
        for index, effect in enumerate(trace.fit.effects)
    ]
    if not trace.exact:
        progress.set_description("looking for forces that nobody declared")
        parts = _with_undeclared(simulation, measured, trace, parts, rng)
    progress.set_description("looking for noise")
    return Explanation((*parts, *_noise(simulation, measured, [part.effect for part in parts])), trace)


def _with_undeclared(
    simulation: Simulation, measured: Measured, trace: Trace, parts: list[Part], rng: np.random.Generator
) -> list[Part]:
    """The parts, with a force that nobody declared beside them or in their place, if that pays."""
    mended = simulation.with_effects(*(part.effect for part in parts))
    candidates = []
    if (beside := find_undeclared(mended, measured)) is not None:
        candidates.append((_beside(simulation, measured, trace, parts, beside), beside, mended))
    # Also if there is none: what effects of the catalogue leave of a force that they imitate may look like nothing.
    if parts and (alone := find_undeclared(simulation, measured)) is not None:
        candidates.append(([Part(alone.effect, False, alone.ci95)], alone, simulation))
    if not candidates:
        return parts
    problem = _with_least_noise(simulation, measured, [parts, *(candidate for candidate, _, _ in candidates)])
    judged = measured.judged()

    def loss(candidate: Sequence[Part]) -> np.ndarray:
        return losses(problem.residual([part.effect for part in candidate], judged))

    first = Problem.pose(simulation, measured)
    before = loss(parts)
    paying = []
    for candidate, force, base in candidates:
        after = loss(candidate)
        pays = after.mean() < (1.0 - _PAYS) * before.mean() and p_value_of_losses(before, after) < _LEVEL
        losses_at_first = (first.held_out_loss([part.effect for part in some]) for some in ([], parts, candidate))
        if pays and matters(*losses_at_first, _WORTH_A_WORD) and _beyond_noise(force, base, measured, rng):
            paying.append((candidate, after))
    if not paying:
        return parts
    least = min(after.mean() for _, after in paying)
    as_good = [candidate for candidate, after in paying if after.mean() <= least / (1.0 - _PAYS)]
    return min(as_good, key=_size)  # of two that are as short, the one with names in it


def _beside(
    simulation: Simulation, measured: Measured, trace: Trace, parts: Sequence[Part], force: Undeclared
) -> list[Part]:
    """The parts that are needed beside a force, and the force as it is then."""
    candidate = [*parts, Part(force.effect, False, force.ci95)]
    if not parts:
        return candidate
    mended = simulation.with_effects(*(part.effect for part in parts))
    problem = replace(Problem.pose(mended, measured), simulation=simulation)
    return _found_anew(simulation, measured, _needed(problem, trace, candidate))


def _with_least_noise(simulation: Simulation, measured: Measured, explanations: Sequence[Sequence[Part]]) -> Problem:
    """The problem that explanations are compared in: where the one that leaves sensors the least noise says they are.

    What an explanation takes for noise of the sensors and another explains is no noise, and states that were smoothed
    by the first would tell against the second.
    """
    mended = [simulation.with_effects(*(part.effect for part in parts)) for parts in explanations]
    spread = np.maximum(measured.observation.std(0), 1e-12)

    def noise(candidate: Simulation) -> float:
        std = sensor_noise(candidate, measured)
        return 0.0 if std is None else float(((std / spread) ** 2).mean())

    return replace(Problem.pose(min(mended, key=noise), measured), simulation=simulation)


def _size(parts: Sequence[Part]) -> int:
    """How much there is to say: an effect of the catalogue is one word, a force one a term."""
    return sum(1 if part.declared else len(part.effect.terms) for part in parts)


def _found_anew(simulation: Simulation, measured: Measured, parts: list[Part]) -> list[Part]:
    """The parts with the force looked for again beside the effects that are left, without terms that are idle now."""
    known = parts[:-1]
    force = find_undeclared(simulation.with_effects(*(part.effect for part in known)), measured)
    return parts if force is None else [*known, Part(force.effect, False, force.ci95)]


def _beyond_noise(force: Undeclared, simulation: Simulation, measured: Measured, rng: np.random.Generator) -> bool:
    """Whether noise alone would not give a force that explains about as much."""
    sensor_std = sensor_noise(simulation, measured)
    if sensor_std is None:
        return True
    by_chance = find_undeclared(simulation, stand_in(simulation, measured, sensor_std, rng))
    return by_chance is None or _explained(force) > _BEYOND_NOISE * _explained(by_chance)


def _explained(force: Undeclared) -> float:
    """The share of the held-out error that a force takes away, mean over the dimensions."""
    return float(np.mean(1.0 - force.error_after / np.maximum(force.error_before, 1e-300)))


def _needed(problem: Problem, trace: Trace, parts: list[Part]) -> list[Part]:
    """The parts without those effects of the catalogue that the force, fitted anew with the rest, makes up for."""
    free = {entry.name: free_parameters(entry) for entry in trace.entries}
    fitted, judged = problem.measured.fitted(), problem.measured.judged()
    names = [entry.name for entry in trace.entries]

    def refitted(chosen: Sequence[int]) -> tuple[list[Part], np.ndarray]:
        effects = [parts[i].effect for i in chosen]
        moved = [free[names[i]] if parts[i].declared else tuple(parts[i].ci95) for i in chosen]
        result = fit(problem, effects, moved, fitted)
        new = [
            Part(effect, parts[i].declared, result.ci95(k), parts[i].alike)
            for k, (i, effect) in enumerate(zip(chosen, result.effects, strict=True))
        ]
        return new, losses(problem.residual(result.effects, judged))

    chosen = list(range(len(parts)))
    best, lowest = refitted(chosen)
    for index in range(len(parts) - 1):
        rest = [i for i in chosen if i != index]
        candidate, after = refitted(rest)
        if after.mean() < lowest.mean() / (1.0 - _PAYS) or p_value_of_losses(after, lowest) > _LEVEL:
            chosen, best, lowest = rest, candidate, after
    return best


def _noise(simulation: Simulation, measured: Measured, found: Sequence[Effect]) -> list[Part]:
    """Noise of the action that the data have and the simulator has not, or the other way round."""
    own = [effect for effect in simulation.effects if isinstance(effect, ActionNoise) and effect.actuators is None]
    own_variance = sum(math.copysign(effect.std**2, effect.std) for effect in own)
    noise = estimate_noise(simulation.with_effects(*found), measured)
    variance = noise.action_std**2 if noise.p_value < _LEVEL else 0.0
    missing = variance - own_variance
    if abs(missing) <= _NOISE_CHANGE * own_variance:
        return []
    std = math.copysign(math.sqrt(abs(missing)), missing)
    half = noise.half_width if variance else 0.0
    return [Part(ActionNoise(std), True, {"std": (std - half, std + half)})]
