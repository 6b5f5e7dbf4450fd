"""Screens a catalogue: estimates how much of a residual each entry could explain, from one simulation per trial."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.trace.fit import Free
from torchrl_h2o.residuals.trace.problem import Problem, losses

LEADS_COMBINED = 60  # number of most promising leads from which sets are formed
# cosine of the angle between two entries' changes of the residual beyond which only the first one is sketched
SAME_CHANGE = 0.999


@dataclass(frozen=True)
class Lead:
    """Result of screening one entry.

    Args:
        entry: entry of the catalogue.
        effect: effect with the values at which a fit should start.
        promise: estimated share of the loss that the effect explains, if the residual is linear in the effect.
        trial: the entry's trial with the highest promise.
        change: linear change of the scaled residual from neutral to the effect, (W · H · n).
    """

    entry: CatalogueEntry
    effect: Effect
    promise: float
    trial: Mapping[str, float]
    change: np.ndarray

    @property
    def free(self) -> Free:
        """Names of the parameters that a fit may move."""
        return free_parameters(self.entry)


def free_parameters(entry: CatalogueEntry) -> Free:
    """Names of the parameters that any trial of an entry moves."""
    return tuple(dict.fromkeys(name for trial in entry.trials for name in trial))


def screen(
    problem: Problem,
    known: Sequence[Effect],
    entries: Sequence[CatalogueEntry],
    starts: np.ndarray,
    advance: Callable[[], object] = lambda: None,
) -> list[Lead]:
    """Estimates the share of the loss that each entry explains in addition to known effects.

    Each trial of an entry is simulated once. The residual is then taken as linear between neutral and the trial, and
    the entry's promise is the reduction of the robust loss at the best point on that line, or at the trial itself.

    Args:
        problem: simulation, data and scales of the residuals.
        known: effects that are put in already.
        entries: entries to screen; random effects and those that the model rejects are skipped.
        starts: (W), first rows of the windows to simulate.
        advance: called after each entry.

    Returns:
        One lead per entry, in descending order of the promise.
    """
    before = problem.residual(known, starts)
    loss = losses(before).mean()
    leads = []
    for entry in entries:
        lead = None if entry.effect.random else _lead(problem, known, entry, starts, before, loss)
        if lead is not None:
            leads.append(lead)
        advance()
    return sorted(leads, key=lambda lead: -lead.promise)


def _lead(
    problem: Problem,
    known: Sequence[Effect],
    entry: CatalogueEntry,
    starts: np.ndarray,
    before: np.ndarray,
    loss: float,
) -> Lead | None:
    best = None
    for trial in entry.trials:
        effect = entry.effect.with_parameters(trial)
        try:
            after = problem.residual([*known, effect], starts)
        except ValueError:  # a value that the model rejects, such as negative total damping
            continue
        share, explained = along(before, after - before)
        reached = 1.0 - losses(after).mean() / max(loss, 1e-300)
        if reached > explained:
            share, explained = 1.0, reached
        start = _towards(entry.effect, trial, share)
        if start.is_neutral or not is_possible(problem, [*known, start]):
            share, explained, start = 0.0, 0.0, effect
        if best is None or explained > best.promise:
            best = Lead(entry, start, explained, trial, (share * (after - before)).ravel().astype(np.float32))
    return best


def along(before: np.ndarray, change: np.ndarray) -> tuple[float, float]:
    """Best step along a change of the residual, between -1 and 2, and the share of the robust loss it removes.

    Args:
        before: residual, of any shape.
        change: linear change of the residual by an effect, of the same shape.
    """
    weight = 1.0 / np.sqrt(1.0 + before**2)
    square = float((weight * change**2).sum())
    if square == 0.0:
        return 0.0, 0.0
    share = float(np.clip(-(weight * change * before).sum() / square, -1.0, 2.0))
    loss = losses(before).mean()
    return share, 1.0 - float(losses(before + share * change).mean() / max(loss, 1e-300))


def unlike(leads: Sequence[Lead], same: float) -> list[Lead]:
    """The leads without those that change the residual as an earlier one does, up to a factor.

    In a planar robot, a larger left wheel does what a larger right wheel does. The others are tried as alternatives.

    Args:
        leads: leads in descending order of their promise.
        same: cosine of the angle between two changes beyond which they count as the same.
    """
    kept, directions = [], []
    for lead in leads:
        size = float(np.linalg.norm(lead.change))
        if size > 0.0 and all(abs(float(lead.change @ other)) < same * size for other in directions):
            kept.append(lead)
            directions.append(lead.change / size)
    return kept


def is_possible(problem: Problem, effects: Sequence[Effect]) -> bool:
    """Whether the model accepts the effects; it rejects, for example, negative total damping."""
    try:
        return problem.simulation.with_effects(*effects).model is not None
    except ValueError:
        return False


def are_possible_alone(problem: Problem, effects: Sequence[Effect]) -> bool:
    """Whether the model accepts each effect without the others.

    Rotor inertia of all joints and a negative one of the knee may be possible together. The knee's alone is not, so no
    later step could remove or exchange the other effect.
    """
    return all(is_possible(problem, [effect]) for effect in effects)


def promising_sets(
    problem: Problem, known: Sequence[Effect], leads: Sequence[Lead], size: int, starts: np.ndarray, keep: int
) -> list[tuple[Lead, ...]]:
    """Ranks all sets of leads of one size by their joint gain in a linear least-squares model.

    Sets are needed if one wrong effect imitates a mixture of two right ones: a search that adds one effect at a time
    would choose the wrong one.

    Args:
        problem: simulation, data and scales of the residuals.
        known: effects that are put in already, as during the screening.
        leads: leads to combine.
        size: leads per set.
        starts: (W), first rows of the screened windows.
        keep: number of sets to return.

    Returns:
        The sets with the highest joint gain, in descending order.
    """
    before = problem.residual(known, starts).ravel()
    weight = 1.0 / np.sqrt(1.0 + before**2)
    changes = np.stack([lead.change for lead in leads], axis=1).astype(float)
    gram = changes.T @ (weight[:, None] * changes)
    pull = -changes.T @ (weight * before)
    sets = np.array(list(combinations(range(len(leads)), size)))
    inner = gram[sets[:, :, None], sets[:, None, :]]
    inner = inner + 1e-6 * np.einsum("sii->s", inner)[:, None, None] * np.eye(size)
    gain = (pull[sets] * np.linalg.solve(inner, pull[sets][..., None])[..., 0]).sum(1)
    return [tuple(leads[i] for i in sets[best]) for best in np.argsort(-gain)[:keep]]


def _towards(effect: Effect, trial: Mapping[str, float], share: float) -> Effect:
    """The effect at a share of the way to a trial, at least 5 %, so that a fit starts with a gradient."""
    share = np.copysign(max(abs(share), 0.05), share)
    values = {}
    for name, target in trial.items():
        parameter = effect.parameters[name]
        start = parameter.neutral
        value = target if not np.isfinite(start) else start + share * (target - start)
        values[name] = float(np.clip(value, *parameter.bounds))
    return effect.with_parameters(values)
