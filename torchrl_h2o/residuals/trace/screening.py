"""Screening: what every entry of a catalogue could explain of a residual, from one or two simulations each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.trace.fit import Free
from torchrl_h2o.residuals.trace.problem import Problem, losses


@dataclass(frozen=True)
class Lead:
    """An entry that may explain something.

    Args:
        entry: of the catalogue.
        effect: with the values from which a fit should start.
        promise: the share of the loss that it would explain if the residual were linear in it.
        trial: of the entry, by which that is seen.
        change: of the residual in scales, (W · H · n), from neutral to the effect, if it were linear.
    """

    entry: CatalogueEntry
    effect: Effect
    promise: float
    trial: Mapping[str, float]
    change: np.ndarray

    @property
    def free(self) -> Free:
        """The parameters that a fit may move."""
        return free_parameters(self.entry)


def free_parameters(entry: CatalogueEntry) -> Free:
    """The parameters of an entry that any of its trials moves."""
    return tuple(dict.fromkeys(name for trial in entry.trials for name in trial))


def screen(
    problem: Problem,
    known: Sequence[Effect],
    entries: Sequence[CatalogueEntry],
    starts: np.ndarray,
    advance: Callable[[], object] = lambda: None,
) -> list[Lead]:
    """What each entry promises beside the effects that are known, the best first.

    Each trial of an entry is simulated once. The residual is then taken as linear between neutral and the trial, and
    the entry's promise is the robust loss that the best point on that line, or the trial itself, would take away.

    Args:
        problem: what to explain.
        known: effects that are in already.
        entries: to be screened; those that the model cannot have are passed over.
        starts: (W), first rows of the windows to look at.
        advance: called after each entry.

    Returns:
        A lead an entry.
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
        except ValueError:  # less damping than the joint has, and the like
            continue
        share, explained = _along(before, after - before)
        reached = 1.0 - losses(after).mean() / max(loss, 1e-300)
        if reached > explained:
            share, explained = 1.0, reached
        start = _towards(entry.effect, trial, share)
        if start.is_neutral or not is_possible(problem, [*known, start]):
            share, explained, start = 0.0, 0.0, effect
        if best is None or explained > best.promise:
            best = Lead(entry, start, explained, trial, (share * (after - before)).ravel().astype(np.float32))
    return best


def _along(before: np.ndarray, change: np.ndarray) -> tuple[float, float]:
    """How far to go along a change of the residual, and the share of the robust loss that it takes away."""
    weight = 1.0 / np.sqrt(1.0 + before**2)
    square = float((weight * change**2).sum())
    if square == 0.0:
        return 0.0, 0.0
    share = float(np.clip(-(weight * change * before).sum() / square, -1.0, 2.0))
    loss = losses(before).mean()
    return share, 1.0 - float(losses(before + share * change).mean() / max(loss, 1e-300))


def is_possible(problem: Problem, effects: Sequence[Effect]) -> bool:
    """Whether the model can have the effects: no less damping than none, and the like."""
    try:
        return problem.simulation.with_effects(*effects).model is not None
    except ValueError:
        return False


def promising_sets(
    problem: Problem, known: Sequence[Effect], leads: Sequence[Lead], size: int, starts: np.ndarray, keep: int
) -> list[tuple[Lead, ...]]:
    """The sets of so many leads that together promise most, all sets being looked at.

    One effect that stands for two others, a little of each, can hide both from a search that adds one at a time.

    Args:
        problem: what to explain.
        known: effects that are in already, as when the leads were screened.
        leads: to choose from.
        size: of the sets.
        starts: (W), the windows that were screened.
        keep: how many sets to return.

    Returns:
        The sets, the best first.
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


def _towards(effect: Effect, trial: dict[str, float], share: float) -> Effect:
    """The effect part of the way to a trial, or the other way, but far enough to see which way is down."""
    share = np.copysign(max(abs(share), 0.05), share)
    values = {}
    for name, target in trial.items():
        parameter = effect.parameters[name]
        start = parameter.neutral
        value = target if not np.isfinite(start) else start + share * (target - start)
        values[name] = float(np.clip(value, *parameter.bounds))
    return effect.with_parameters(values)
