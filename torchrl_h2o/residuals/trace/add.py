"""Finds the set of entries whose addition lowers the held-out loss most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.noise_gain import explained_by_noise
from torchrl_h2o.residuals.trace.outcome import Attempt
from torchrl_h2o.residuals.trace.problem import matters
from torchrl_h2o.residuals.trace.screening import (
    Lead,
    are_possible_alone,
    free_parameters,
    is_possible,
    promising_sets,
)
from torchrl_h2o.residuals.trace.state import SearchState

Sketch = tuple[tuple[Lead, ...], Fit]  # a set of leads, and a quick fit with them


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A set of entries added to those found.

    Args:
        entries: the entries found, then the added ones.
        fit: joint fit.
        added: number of added entries.
        losses: (W), losses of the held-out windows.
        first_loss: mean held-out loss, with the scales of the residuals before the first effect was added.
    """

    entries: tuple[CatalogueEntry, ...]
    fit: Fit
    added: int
    losses: np.ndarray
    first_loss: float


def best_addition(state: SearchState, leads: Sequence[Lead], rng: np.random.Generator) -> SearchState:
    """Adds the set of one to three entries that lowers the held-out loss most.

    A larger set is preferred only if its loss is significantly lower than that of the best smaller set.

    Args:
        state: effects found so far.
        leads: screened entries, in descending order of their promise.
        rng: generator of synthetic noise.

    Returns:
        The state with the set added, or without it if no set passes the tests; its attempts include the sketches.
    """
    rules, effects = state.settings.trace, state.fit.effects
    before = state.selection_losses(effects)
    present = _Candidate(state.entries, state.fit, 0, before, state.first.selection_loss(effects))
    best = present
    for size, count in rules.set_sizes:
        among = [lead for lead in leads[: rules.leads_combined] if lead.promise > 0.0]
        if len(among) < size or len(state.entries) + size > rules.max_effects:
            break
        sketches = _sketches(state, leads, among, size, count)
        if size == 1:
            state = _remember(state, sketches)
        best = _best_of(state, sorted(sketches, key=lambda sketch: sketch[1].loss), present, best)
    if best is present:
        return state
    explained = 1.0 - best.losses.mean() / before.mean()
    free = [*(() for _ in effects), *(free_parameters(entry) for entry in best.entries[-best.added :])]
    by_noise = explained_by_noise(state, (*effects, *best.fit.effects[-best.added :]), free, rng)
    return state.with_found(best.entries, best.fit) if explained > rules.beyond_noise * by_noise else state


def _sketches(state: SearchState, leads: Sequence[Lead], among: Sequence[Lead], size: int, count: int) -> list[Sketch]:
    """Quick fits of the most promising sets of one size."""
    effects = state.fit.effects
    sets = [(lead,) for lead in leads[:count]]
    if size > 1:
        sets = promising_sets(state.problem, effects, among, size, state.windows.screened, count)
    kept = [() for _ in effects]
    sketches = []
    for chosen in sets:
        together = [*effects, *(lead.effect for lead in chosen)]
        if is_possible(state.problem, together):
            free = [*kept, *(lead.free for lead in chosen)]
            sketches.append((chosen, state.sketched(together, free, state.settings.trace.sketch_evaluations)))
    return sketches


def _remember(state: SearchState, sketches: Sequence[Sketch]) -> SearchState:
    """Records what single entries explain in addition to the effects found, for the report."""
    before, index = state.selection_losses(state.fit.effects), len(state.fit.effects)
    attempts = dict(state.attempts)
    for (lead,), sketch in sketches:
        after = state.selection_losses(sketch.effects)
        p = state.p_value(before, after)
        attempts[lead.entry.name] = Attempt(lead.entry, sketch, index, float(after.mean()), p)
    return replace(state, attempts=attempts)


def _best_of(state: SearchState, sketches: Sequence[Sketch], present: _Candidate, best: _Candidate) -> _Candidate:
    """The best candidate so far or, if it passes the tests, one of the sketched sets after a full fit."""
    rules, nothing = state.settings.trace, state.first_loss
    finalists = 0
    for chosen, start in sketches:
        entries = (*state.entries, *(lead.entry for lead in chosen))
        fitted = state.refitted(entries, start.effects)
        if not are_possible_alone(state.problem, fitted.effects):
            continue
        first_loss = state.first.selection_loss(fitted.effects)
        # each added effect must contribute its share; a set that fails this does not count as a finalist
        if not matters(nothing, present.first_loss, first_loss, len(chosen) * rules.min_share):
            continue
        candidate = _Candidate(entries, fitted, len(chosen), state.selection_losses(fitted.effects), first_loss)
        if _pays(state, best, candidate):
            best = candidate
        finalists += 1
        if finalists == rules.finalists:
            break
    return best


def _pays(state: SearchState, best: _Candidate, candidate: _Candidate) -> bool:
    """Whether a candidate's loss is lower than the best one's by a minimum share, and significantly."""
    rules = state.settings.trace
    least = rules.min_gain if state.problem.sensor_std is None else rules.min_gain_under_noise
    level = state.settings.significance.level / len(state.catalogue)
    share = (candidate.added - best.added) * rules.min_share
    return (
        candidate.losses.mean() < (1.0 - least) * best.losses.mean()
        and state.p_value(best.losses, candidate.losses) < level
        and matters(state.first_loss, best.first_loss, candidate.first_loss, share)
    )
