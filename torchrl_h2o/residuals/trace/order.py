"""Orders effects that do not commute, such as a delay and backlash of the same action."""

from __future__ import annotations

from itertools import combinations

from torchrl_h2o.effects import ActionEffect, ObservationEffect
from torchrl_h2o.residuals.trace.state import SearchState


def reorder(state: SearchState) -> SearchState:
    """Swaps pairs of action effects, and of observation effects, if that lowers the held-out loss significantly."""
    lowest = state.selection_losses(state.fit.effects)
    for kind in (ActionEffect, ObservationEffect):
        places = [index for index, entry in enumerate(state.entries) if isinstance(entry.effect, kind)]
        for one, other in combinations(places, 2):
            order = list(range(len(state.entries)))
            order[one], order[other] = other, one
            swapped = tuple(state.entries[index] for index in order)
            fitted = state.refitted(swapped, [state.fit.effects[index] for index in order])
            after = state.selection_losses(fitted.effects)
            significant = state.p_value(lowest, after) < state.settings.level
            if after.mean() < lowest.mean() and significant:
                state, lowest = state.with_found(swapped, fitted), after
    return state
