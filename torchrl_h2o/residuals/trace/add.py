"""Finds the sets of entries whose addition lowers the held-out loss most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.trace.families import number_of_effects
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.noise_gain import explained_by_noise
from torchrl_h2o.residuals.trace.outcome import Attempt
from torchrl_h2o.residuals.trace.problem import MIN_GAIN, MIN_GAIN_UNDER_NOISE, matters
from torchrl_h2o.residuals.trace.screening import (
    LEADS_COMBINED,
    SAME_CHANGE,
    Lead,
    are_possible_alone,
    free_parameters,
    is_possible,
    promising_sets,
    unlike,
)
from torchrl_h2o.residuals.trace.significance import BEYOND_NOISE
from torchrl_h2o.residuals.trace.state import MUCH_LOWER, SKETCH_EVALUATIONS, SearchState

# share of the held-out loss; an addition that explains more passes without a test against synthetic noise
SURELY_BEYOND_NOISE = 0.5
# pairs (size of a set, number of sets of this size that are sketched); larger sets if no smaller one helps
SET_SIZES = ((1, 16), (2, 4), (3, 4))
FINALISTS = 3  # number of sketched sets of one size that are fitted on all windows of the search, at least
CLOSE_SKETCH = 0.4  # share of the gain of the best sketch of one size from which further sets are fitted
BEAM_WIDTH = 3  # largest number of lists of effects that the search grows side by side
BEAM_LOSS = 1.25  # multiple of the lowest loss up to which another list is grown as well
SAME_FIT = 1e-3  # relative difference up to which two losses count as equal

Found = TypeVar("Found")
Sketch = tuple[tuple[Lead, ...], Fit]  # a set of leads, and a quick fit with them


@dataclass(frozen=True, eq=False)
class Addition:
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


@dataclass(frozen=True, eq=False)
class Additions:
    """Sets of entries that lower the held-out loss by enough, and significantly.

    Args:
        state: effects found so far; its attempts include the sketches of single entries.
        leads: screened entries.
        passed: the additions, in ascending order of their loss.
        near: those that come close to the best one, and that noise alone does not explain.
    """

    state: SearchState
    leads: Sequence[Lead]
    passed: Sequence[Addition] = ()
    near: Sequence[Addition] = ()


def additions(
    state: SearchState,
    leads: Sequence[Lead],
    rng: np.random.Generator,
    advance: Callable[[], object] = lambda: None,
) -> Additions:
    """Finds the sets of entries that lower the held-out loss by enough, and significantly.

    Pairs are tried if no single entry passes the tests, and sets of three if no pair does, because one of two effects
    may increase the loss as long as the other one is missing. Pairs and larger sets are not tried if so little of the
    loss is left that even a set that explains all of it would not contribute its share. Single entries are always
    tried, because an entry that halves the present loss may pass without this share.

    Args:
        state: effects found so far.
        leads: screened entries, in descending order of their promise.
        rng: generator of synthetic noise.
        advance: called before each fit.

    Returns:
        The additions of the smallest size of which one passes, or none.
    """
    among = [lead for lead in leads[:LEADS_COMBINED] if lead.promise > 0.0]
    left = state.first.selection_loss(state.fit.effects)
    for size, count in SET_SIZES:
        enough_left = size == 1 or matters(state.first_loss, left, 0.0, size * state.min_share)
        if len(among) < size or number_of_effects(state) + size > state.settings.max_effects or not enough_left:
            break
        sketches = _sketches(state, leads, among, size, count, advance)
        if size == 1:
            state = _remember(state, sketches)
        found = tested(state, leads, sketches, rng, advance)
        if found.near:
            return found
    return Additions(state, leads)


def tested(
    state: SearchState,
    leads: Sequence[Lead],
    sketches: Sequence[Sketch],
    rng: np.random.Generator,
    advance: Callable[[], object],
) -> Additions:
    """The sketched sets that pass the tests after a full fit.

    Args:
        state: effects found so far.
        leads: screened entries.
        sketches: sets of leads, each with a quick fit.
        rng: generator of synthetic noise.
        advance: called before each fit.
    """
    before = state.selection_losses(state.fit.effects)
    present = Addition(state.entries, state.fit, 0, before, state.first.selection_loss(state.fit.effects))
    fitted = _fitted(state, sketches, advance)
    passed = sorted((one for one in fitted if _pays(state, present, one)), key=_loss)
    near = [one for one in _close_to_best(passed) if _exceeds_noise(state, one, before.mean(), rng)]
    return Additions(state, leads, passed, near)


def _close_to_best(found: Sequence[Addition]) -> list[Addition]:
    """The leading additions whose loss is close to the lowest, without duplicates; at most ``beam_width``."""
    near = [one for one in found if one.loss <= BEAM_LOSS * found[0].loss]
    return distinct(near, _loss, SAME_FIT)[:BEAM_WIDTH]


def _loss(addition: Addition) -> float:
    return addition.loss


def distinct(found: Sequence[Found], loss: Callable[[Found], float], same: float) -> list[Found]:
    """Keeps the first of any items with nearly equal losses.

    Equal losses are taken as equal motion: for example, a gain of all motors changes the motion as the mass of all
    bodies does.

    Args:
        found: the items.
        loss: returns the loss of an item.
        same: relative difference up to which two losses count as equal.
    """
    kept: list[Found] = []
    for one in found:
        if all(abs(loss(one) - loss(other)) > same * loss(other) for other in kept):
            kept.append(one)
    return kept


def _exceeds_noise(state: SearchState, addition: Addition, before: float, rng: np.random.Generator) -> bool:
    """Whether an addition explains clearly more of the loss than it does in data with sensor noise alone."""
    gain = 1.0 - addition.loss / before
    if gain > SURELY_BEYOND_NOISE:
        return True
    effects, added = state.fit.effects, addition.entries[-addition.added :]
    free = [*(() for _ in effects), *map(free_parameters, added)]
    by_noise = explained_by_noise(state, (*effects, *addition.fit.effects[-addition.added :]), free, rng)
    return gain > BEYOND_NOISE * by_noise


def _sketches(
    state: SearchState,
    leads: Sequence[Lead],
    among: Sequence[Lead],
    size: int,
    count: int,
    advance: Callable[[], object],
) -> list[Sketch]:
    """Quick fits of the most promising sets of one size."""
    effects = state.fit.effects
    sets = [(lead,) for lead in unlike(leads, SAME_CHANGE)[:count]]
    if size > 1:
        sets = promising_sets(state.problem, effects, among, size, state.windows.screened, count)
    sketches = []
    for chosen in sets:
        advance()
        sketch = sketched_set(state, [*effects, *(lead.effect for lead in chosen)], chosen)
        if sketch is not None:
            sketches.append((chosen, sketch))
    return sketches


def sketched_set(state: SearchState, start: Sequence[Effect], added: Sequence[Lead]) -> Fit | None:
    """Quick fit of the effects found and of added leads; None if the model rejects the values at the start.

    Args:
        state: effects found so far; their parameters move as well, because they made up for what is missing.
        start: the effects found and the added ones, with the values from which the fit starts.
        added: leads of the added effects.
    """
    if not is_possible(state.problem, start):
        return None
    free = [*map(free_parameters, state.entries), *(lead.free for lead in added)]
    return state.sketched(start, free, SKETCH_EVALUATIONS)


def _remember(state: SearchState, sketches: Sequence[Sketch]) -> SearchState:
    """Records what single entries explain in addition to the effects found, for the report."""
    problem, present, attempts = state.problem, state.fit.effects, dict(state.attempts)
    before = problem.selection_losses(present)
    for (lead,), sketch in sketches:
        after = problem.selection_losses(sketch.effects)
        p = state.p_value(before, after)
        attempts[lead.entry.name] = Attempt(lead.entry, sketch, len(present), float(after.mean()), p)
    return replace(state, attempts=attempts)


def _sketch_loss(sketch: Sketch) -> float:
    return sketch[1].loss


def _fitted(state: SearchState, sketches: Sequence[Sketch], advance: Callable[[], object]) -> list[Addition]:
    """The sketched sets that come close to the best one, after a full fit."""
    ranked = distinct(sorted(sketches, key=_sketch_loss), _sketch_loss, SAME_FIT)
    without = state.screened_loss(state.fit.effects)
    candidates = []
    for tried, (chosen, start) in enumerate(ranked):
        gain, most = without - start.loss, without - ranked[0][1].loss
        if tried >= FINALISTS and gain < CLOSE_SKETCH * most:
            break
        advance()
        entries = (*state.entries, *(lead.entry for lead in chosen))
        fitted = state.refitted(entries, start.effects)
        if not are_possible_alone(state.problem, fitted.effects):
            continue
        first_loss = state.first.selection_loss(fitted.effects)
        fit_losses = state.selection_losses(fitted.effects)
        candidates.append(Addition(entries, fitted, len(chosen), fit_losses, first_loss))
    return candidates


def _pays(state: SearchState, present: Addition, candidate: Addition) -> bool:
    """Whether a candidate lowers the loss by a minimum share, and significantly."""
    least = MIN_GAIN if state.problem.sensor_std is None else MIN_GAIN_UNDER_NOISE
    level = state.settings.level / len(state.catalogue)
    return (
        candidate.loss < (1.0 - least) * present.loss
        and state.p_value(present.losses, candidate.losses) < level
        and _matters(state, present, candidate)
    )


def _matters(state: SearchState, present: Addition, candidate: Addition) -> bool:
    """Whether the added effects contribute their required shares, or lower the present loss by a large factor."""
    much = candidate.loss < MUCH_LOWER * present.loss
    share = candidate.added * state.min_share
    return much or matters(state.first_loss, present.first_loss, candidate.first_loss, share)
