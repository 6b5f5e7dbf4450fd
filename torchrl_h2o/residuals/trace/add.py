"""Finds the sets of entries whose addition lowers the held-out loss most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.noise_gain import explained_by_noise
from torchrl_h2o.residuals.trace.outcome import Attempt
from torchrl_h2o.residuals.trace.problem import losses, matters
from torchrl_h2o.residuals.trace.screening import (
    Lead,
    are_possible_alone,
    free_parameters,
    is_possible,
    promising_sets,
)
from torchrl_h2o.residuals.trace.state import SearchState

Found = TypeVar("Found")
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

    @property
    def loss(self) -> float:
        """Mean loss of the held-out windows."""
        return float(self.losses.mean())


def additions(state: SearchState, leads: Sequence[Lead], rng: np.random.Generator) -> list[SearchState]:
    """Adds the entry that lowers the held-out loss most, or another entry that comes close to it.

    Pairs are tried where no single entry passes the tests, and sets of three where no pair does: one of two effects may
    increase the loss as long as the other one is missing.

    Args:
        state: effects found so far.
        leads: screened entries, in descending order of their promise.
        rng: generator of synthetic noise.

    Returns:
        The state with each of these additions, in ascending order of their loss; empty if no set passes the tests.
        Their attempts include the sketches.
    """
    rules, effects = state.settings.trace, state.fit.effects
    before = state.selection_losses(effects)
    present = _Candidate(state.entries, state.fit, 0, before, state.first.selection_loss(effects))
    among = [lead for lead in leads[: rules.leads_combined] if lead.promise > 0.0]
    for size, count in rules.set_sizes:
        if len(among) < size or len(state.entries) + size > rules.max_effects:
            break
        sketches = _sketches(state, leads, among, size, count)
        if size == 1:
            state = _remember(state, sketches)
        candidates = [one for one in _fitted(state, sketches) if _pays(state, present, one)]
        added = _best(state, candidates, before.mean(), rng)
        if added:
            return added
    return []


def _best(
    state: SearchState, candidates: Sequence[_Candidate], before: float, rng: np.random.Generator
) -> list[SearchState]:
    """The states with the candidates whose loss comes close to the lowest one and that noise alone does not explain."""
    rules = state.settings.trace
    ranked = sorted(candidates, key=lambda one: one.loss)
    near = [one for one in ranked if one.loss <= rules.beam_loss * ranked[0].loss]
    chosen = distinct(near, lambda one: one.loss, rules.same_fit)[: rules.beam_width]
    return [state.with_found(one.entries, one.fit) for one in chosen if _exceeds_noise(state, one, before, rng)]


def distinct(found: Sequence[Found], loss: Callable[[Found], float], same: float) -> list[Found]:
    """Those whose loss differs from that of each earlier one by more than a share.

    Equal losses mean equal motion: a gain of all motors does what the mass of all bodies does.
    """
    kept: list[Found] = []
    for one in found:
        if all(abs(loss(one) - loss(other)) > same * loss(other) for other in kept):
            kept.append(one)
    return kept


def _exceeds_noise(state: SearchState, candidate: _Candidate, before: float, rng: np.random.Generator) -> bool:
    """Whether a candidate explains clearly more of the loss than it does in data with sensor noise alone."""
    effects, added = state.fit.effects, candidate.entries[-candidate.added :]
    free = [*(() for _ in effects), *map(free_parameters, added)]
    by_noise = explained_by_noise(state, (*effects, *candidate.fit.effects[-candidate.added :]), free, rng)
    return 1.0 - candidate.loss / before > state.settings.trace.beyond_noise * by_noise


def _sketches(state: SearchState, leads: Sequence[Lead], among: Sequence[Lead], size: int, count: int) -> list[Sketch]:
    """Quick fits of the most promising sets of one size."""
    effects = state.fit.effects
    sets = [(lead,) for lead in leads[:count]]
    if size > 1:
        sets = promising_sets(state.problem, effects, among, size, state.windows.screened, count)
    present = [free_parameters(entry) for entry in state.entries]  # they made up for what is missing
    sketches = []
    for chosen in sets:
        together = [*effects, *(lead.effect for lead in chosen)]
        if is_possible(state.problem, together):
            free = [*present, *(lead.free for lead in chosen)]
            sketches.append((chosen, state.sketched(together, free, state.settings.trace.sketch_evaluations)))
    return sketches


def _remember(state: SearchState, sketches: Sequence[Sketch]) -> SearchState:
    """Records what single entries explain in addition to the effects found, for the report."""
    problem, present, attempts = state.problem, state.fit.effects, dict(state.attempts)
    judged = problem.measured.selected_on(problem.horizon)
    settled = problem.settled(present, judged)
    before = losses(settled.residual(present, judged))
    for (lead,), sketch in sketches:
        after = losses(settled.residual(sketch.effects, judged))
        p = state.p_value(before, after)
        attempts[lead.entry.name] = Attempt(lead.entry, sketch, len(present), float(after.mean()), p)
    return replace(state, attempts=attempts)


def _sketch_loss(sketch: Sketch) -> float:
    return sketch[1].loss


def _fitted(state: SearchState, sketches: Sequence[Sketch]) -> list[_Candidate]:
    """The sketched sets that come close to the best one, after a full fit."""
    rules = state.settings.trace
    ranked = distinct(sorted(sketches, key=_sketch_loss), _sketch_loss, rules.same_fit)
    without = state.screened_loss(state.fit.effects)
    candidates = []
    for tried, (chosen, start) in enumerate(ranked):
        gain, most = without - start.loss, without - ranked[0][1].loss
        if tried >= rules.finalists and gain < rules.close_sketch * most:
            break
        entries = (*state.entries, *(lead.entry for lead in chosen))
        fitted = state.refitted(entries, start.effects)
        if not are_possible_alone(state.problem, fitted.effects):
            continue
        first_loss = state.first.selection_loss(fitted.effects)
        fit_losses = state.selection_losses(fitted.effects)
        candidates.append(_Candidate(entries, fitted, len(chosen), fit_losses, first_loss))
    return candidates


def _pays(state: SearchState, present: _Candidate, candidate: _Candidate) -> bool:
    """Whether a candidate lowers the loss by a minimum share, and significantly."""
    rules = state.settings.trace
    least = rules.min_gain if state.problem.sensor_std is None else rules.min_gain_under_noise
    level = state.settings.significance.level / len(state.catalogue)
    return (
        candidate.loss < (1.0 - least) * present.loss
        and state.p_value(present.losses, candidate.losses) < level
        and _matters(state, present, candidate)
    )


def _matters(state: SearchState, present: _Candidate, candidate: _Candidate) -> bool:
    """Whether each added effect contributes its share of the whole reduction, or all of them reduce the rest much."""
    rules = state.settings.trace
    much = candidate.loss < rules.much_lower * present.loss
    share = candidate.added * state.min_share
    return much or matters(state.first_loss, present.first_loss, candidate.first_loss, share)
