"""Finds other sets of up to three effects that explain the data as well, and prefers the most usual of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.effects.catalogue.plausibility import is_outside
from torchrl_h2o.residuals.trace.close_comparison import ALIKE_LOSS, SAME_LOSS, worse_of
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.outcome import RivalSet
from torchrl_h2o.residuals.trace.screening import (
    LEADS_COMBINED,
    Lead,
    are_possible_alone,
    free_parameters,
    is_possible,
    promising_sets,
    screen,
)
from torchrl_h2o.residuals.trace.state import SKETCH_EVALUATIONS, SearchState

RIVAL_SET_SIZE = 3  # largest number of effects in another set that may explain the data as well
RIVAL_SETS = 8  # number of such sets of each size that get a quick fit
RIVAL_FINALISTS = 3  # number of such sets of each size that are fitted on all windows of the search


def with_most_usual_set(
    state: SearchState, advance: Callable[[], object] = lambda: None
) -> tuple[SearchState, tuple[RivalSet, ...]]:
    """Replaces the effects found by a more usual set that explains the data as well, and lists the other sets.

    A log in which the torque follows the motion cannot tell a weak motor from friction and rotor inertia. A search that
    adds one effect at a time finds the set with the fewest parameters first, which need not be the right one.

    Args:
        state: effects found.
        advance: called after each set that was fitted.

    Returns:
        The state with the most usual set, unchanged if that is the one found, and the other sets, in ascending order of
        their surprise and loss.
    """
    # the alternatives of a single exact effect are already in its group
    if not state.entries or (state.exact and len(state.entries) == 1):
        return state, ()
    sets = rival_sets(state, advance)
    own_loss = float(state.selection_losses(state.fit.effects).mean())
    own = RivalSet(state.entries, state.fit, own_loss)
    best = min((own, *sets), key=lambda one: one.surprise)  # the first of equals, so the own set is kept
    others = tuple(sorted((one for one in (own, *sets) if one is not best), key=lambda one: (one.surprise, one.loss)))
    if best is own:
        return state, others
    return state.with_found(best.entries, best.fit), others


def rival_sets(state: SearchState, advance: Callable[[], object] = lambda: None) -> tuple[RivalSet, ...]:
    """Sets of one to three effects whose loss is not significantly higher than that of the effects found.

    Residuals are scaled by their size without effects, which favours no set. With this scaling, the noise of one
    quantity may hide a difference in another. A set is therefore also ruled out if it is worse both with residuals
    scaled by what the effects found leave and with residuals scaled by what the set itself leaves.
    """
    state = state.rescaled(state.posed_instead(()))
    with_it, without = (state.selection_losses(effects) for effects in (state.fit.effects, ()))
    explained = float(without.mean() - with_it.mean())
    if explained <= 0.0:
        return ()
    found = []
    for entries, sketch in _sketched_sets(state, advance):
        advance()
        fitted = state.refitted(entries, sketch.effects)
        after = state.selection_losses(fitted.effects)
        missed = (after.mean() - with_it.mean()) / explained
        if state.exact:
            alike = missed < SAME_LOSS
        else:
            close = missed < ALIKE_LOSS
            alike = close and state.p_value(after, with_it) > state.settings.level
            alike = alike and worse_of(state, fitted, state.fit) is not fitted
        if alike and _is_plausible(state, fitted):
            found.append(RivalSet(tuple(entries), fitted, float(after.mean())))
    return tuple(found)


def _is_plausible(state: SearchState, fitted: Fit) -> bool:
    """Whether each effect is possible without the others, and none places a mass far outside the model."""
    outside = any(is_outside(effect, state.problem.simulation.model) for effect in fitted.effects)
    return not outside and are_possible_alone(state.problem, fitted.effects)


def _sketched_sets(state: SearchState, advance: Callable[[], object]) -> list[tuple[list[CatalogueEntry], Fit]]:
    """The most promising sets of each size whose quick fit reaches the required share of the gain, with these fits."""
    screened = state.windows.screened
    leads = screen(state.problem, (), state.catalogue, screened)
    among = [lead for lead in leads[:LEADS_COMBINED] if lead.promise > 0.0]
    few_with_it, few_without = map(state.screened_loss, (state.fit.effects, ()))
    needed = state.rival_min_sketch * (few_without - few_with_it)
    chosen = []
    for size in range(1, RIVAL_SET_SIZE + 1):
        if len(among) < size:
            break
        sketches = []
        for leads_of_set in promising_sets(state.problem, (), among, size, screened, RIVAL_SETS):
            entries = [lead.entry for lead in leads_of_set]
            if _is_new(state, leads_of_set) and is_possible(state.problem, [lead.effect for lead in leads_of_set]):
                free = [free_parameters(entry) for entry in entries]
                sketch = state.sketched([lead.effect for lead in leads_of_set], free, SKETCH_EVALUATIONS)
                advance()
                if few_without - sketch.loss >= needed:
                    sketches.append((entries, sketch))
        chosen += sorted(sketches, key=lambda one: one[1].loss)[:RIVAL_FINALISTS]
    return chosen


def _is_new(state: SearchState, leads: Sequence[Lead]) -> bool:
    """Whether a set contains other effects than the one found, and not merely more of them."""
    own, names = {entry.name for entry in state.entries}, {lead.entry.name for lead in leads}
    return not names >= own
