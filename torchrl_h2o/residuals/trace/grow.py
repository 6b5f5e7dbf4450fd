"""Grows the list of effects: adds the best set, drops what it makes redundant, reorders, and rescales the residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.trace.add import best_addition
from torchrl_h2o.residuals.trace.eliminate import eliminate
from torchrl_h2o.residuals.trace.noise_free import without_noise
from torchrl_h2o.residuals.trace.order import reorder
from torchrl_h2o.residuals.trace.screening import Lead, screen
from torchrl_h2o.residuals.trace.state import SearchState

SCREENING, ADDITION = 0.2, 0.3  # shares by which a screening and an addition bring the bar closer to the stage's end


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
        found: called after each addition.
    """
    state = _rescale(state)
    while not state.exact and len(state.entries) < state.settings.trace.max_effects:
        screened = state.windows.screened
        one_more = partial(progress.closer, SCREENING / max(1, len(state.others)))
        leads = screen(state.problem, state.fit.effects, state.others, screened, one_more)
        grown = best_addition(state, leads, rng)
        if len(grown.entries) == len(state.entries):
            return grown
        grown = _remember_leads(grown, leads, grown.entries[len(state.entries) :])
        state = _rescale(reorder(eliminate(grown)))
        progress.closer(ADDITION)
        progress.set_postfix_str(", ".join(entry.name for entry in state.entries))
        found(state)
    return state


def _remember_leads(state: SearchState, leads: Sequence[Lead], added: Sequence) -> SearchState:
    """Keeps the leads as rivals of the added entries, and each entry's best trial for later screenings."""
    rivals = {**state.rivals, **{entry.name: leads for entry in added}}
    narrowed = {lead.entry.name: replace(lead.entry, trials=(dict(lead.trial),)) for lead in leads}
    catalogue = tuple(narrowed.get(entry.name, entry) for entry in state.catalogue)
    return replace(state, rivals=rivals, catalogue=catalogue)


def _rescale(state: SearchState) -> SearchState:
    """Scales residuals by their present size; refits if the better simulator gives other start states."""
    posed = state.posed_at(state.fit.effects)
    rescaled = state.rescaled(posed)
    if state.entries and not np.array_equal(state.problem.states, posed.states):
        refitted = rescaled.with_found(state.entries, rescaled.refitted(state.entries, state.fit.effects))
        kept = eliminate(refitted)
        posed = kept.posed_at(kept.fit.effects)
        rescaled = kept.rescaled(posed)
    return without_noise(replace(rescaled, exact=posed.within_rounding))
