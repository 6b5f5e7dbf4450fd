"""Grows lists of effects side by side (a beam search): adds sets, drops what they make redundant, and rescales.

A search that keeps only one list goes astray where a wrong effect imitates two right ones. A heavier torso and friction
of the axles look like heavier wheels until one of the two has been put in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter

import numpy as np

from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.trace.add import additions, distinct
from torchrl_h2o.residuals.trace.eliminate import eliminate
from torchrl_h2o.residuals.trace.noise_free import without_noise
from torchrl_h2o.residuals.trace.order import reorder
from torchrl_h2o.residuals.trace.screening import Lead, free_parameters, screen
from torchrl_h2o.residuals.trace.state import SearchState

SCREENING, ADDITION = 0.07, 0.1  # shares by which a screening and an addition bring the bar closer to the stage's end


def grow(
    state: SearchState,
    rng: np.random.Generator,
    progress: LoopBar,
    found: Callable[[SearchState], object] = lambda state: None,
) -> SearchState:
    """Adds effects until no addition passes the tests, the limit is reached, or the residual is within rounding.

    Args:
        state: effects found so far.
        rng: generator of synthetic noise.
        progress: bar that moves with every screened entry and names the effects found.
        found: called with the best list of effects after each round of additions.
    """
    beam, complete = [_rescale(state)], []
    seen = {_names(state)}
    while True:
        grown = [(one, _grown(one, seen, rng, progress)) for one in beam]
        complete += [one for one, more in grown if not more]
        beam = [each for _, more in grown for each in more]
        if not beam:
            return _simplest_of_best(complete)
        exact = [one for one in beam if one.exact]
        lists = [min(exact, key=_size)] if exact else _closest([*complete, *beam])
        progress.show_found(lists[0].entries)
        found(lists[0])
        if exact:
            return lists[0]
        beam, complete = ([one for one in lists if one in which] for which in (beam, complete))


def _grown(
    state: SearchState, seen: set[frozenset[str]], rng: np.random.Generator, progress: LoopBar
) -> list[SearchState]:
    """The states with one set of effects more, other than those seen so far; empty if the list is complete."""
    if state.exact or len(state.entries) >= state.settings.trace.max_effects:
        return []
    one_more = partial(progress.closer, SCREENING / max(1, len(state.others)))
    leads = screen(state.problem, state.fit.effects, state.others, state.windows.screened, one_more)
    grown = []
    for added in additions(state, leads, rng):
        added = _remember_leads(added, leads, added.entries[len(state.entries) :])
        added = _rescale(reorder(eliminate(added)))
        progress.closer(ADDITION)
        if _names(added) not in seen:
            seen.add(_names(added))
            grown.append(added)
        if added.exact:
            break
    return grown


def _names(state: SearchState) -> frozenset[str]:
    return frozenset(entry.name for entry in state.entries)


def _closest(states: Sequence[SearchState]) -> list[SearchState]:
    """The states whose loss comes close to the lowest one, in ascending order of their loss.

    The losses are compared with residuals scaled by what the best list leaves, because those with the scales of the
    first effect say little about the last one.
    """
    rules = states[0].settings.trace
    means = [float(losses.mean()) for losses in _comparable_losses(states)]
    pairs = sorted(zip(means, states, strict=True), key=lambda pair: (pair[0], _size(pair[1])))
    near = [pair for pair in pairs if pair[0] <= rules.beam_loss * pairs[0][0]]
    return [state for _, state in distinct(near, itemgetter(0), rules.same_fit)[: rules.beam_width]]


def _simplest_of_best(states: Sequence[SearchState]) -> SearchState:
    """Of the states whose loss is not significantly higher than the lowest one, the one with the fewest parameters."""
    if len(states) == 1:
        return states[0]
    losses = _comparable_losses(states)
    best = min(losses, key=np.mean)
    level = states[0].settings.significance.level
    as_good = [one for one, loss in zip(states, losses, strict=True) if states[0].p_value(loss, best) > level]
    return min(as_good, key=_size)


def _comparable_losses(states: Sequence[SearchState]) -> list[np.ndarray]:
    """Losses of the selection windows, (W) for each state, with residuals scaled by what the best state leaves."""
    best = min(states, key=lambda one: one.first.selection_loss(one.fit.effects))
    return [best.selection_losses(one.fit.effects) for one in states]


def _size(state: SearchState) -> tuple[int, int]:
    """Number of fitted parameters, and how unusual the effects are."""
    free = sum(len(free_parameters(entry)) for entry in state.entries)
    return free, sum(map(surprise, state.fit.effects))


def _remember_leads(state: SearchState, leads: Sequence[Lead], added: Sequence) -> SearchState:
    """Keeps the leads as rivals of the added entries, and each entry's best trial for later screenings."""
    rivals = {**state.rivals, **{entry.name: leads for entry in added}}
    narrowed = {lead.entry.name: replace(lead.entry, trials=(dict(lead.trial),)) for lead in leads}
    catalogue = tuple(narrowed.get(entry.name, entry) for entry in state.catalogue)
    return replace(state, rivals=rivals, catalogue=catalogue)


def _rescale(state: SearchState) -> SearchState:
    """Scales residuals by their present size; refits if the better simulator gives other observed start states."""
    posed = state.posed_at(state.fit.effects)
    rescaled, observed = state.rescaled(posed), posed.simulation.state_map.observations
    if state.entries and not np.array_equal(observed(state.problem.states), observed(posed.states)):
        refitted = rescaled.with_found(state.entries, rescaled.refitted(state.entries, state.fit.effects))
        kept = eliminate(refitted)
        posed = kept.posed_at(kept.fit.effects)
        rescaled = kept.rescaled(posed)
    return without_noise(replace(rescaled, exact=posed.within_rounding))
