"""Backward elimination: removes effects without which the held-out loss is not significantly higher."""

from __future__ import annotations

from torchrl_h2o.residuals.trace.screening import is_possible
from torchrl_h2o.residuals.trace.state import SearchState


def eliminate(state: SearchState) -> SearchState:
    """Removes effects one by one as long as the held-out loss without one is not significantly higher."""
    while len(state.entries) > 1:
        smaller = _without_one(state)
        if smaller is None:
            return state
        state = smaller
    return state


def _without_one(state: SearchState) -> SearchState | None:
    """The state without the first effect that is not needed; None if all are needed."""
    before = state.selection_losses(state.fit.effects)
    most = before.mean() / (1.0 - state.settings.trace.min_gain)
    for index in range(len(state.entries)):
        entries = (*state.entries[:index], *state.entries[index + 1 :])
        kept = (*state.fit.effects[:index], *state.fit.effects[index + 1 :])
        if not is_possible(state.problem, kept):
            continue
        fitted = state.refitted(entries, kept)
        after = state.selection_losses(fitted.effects)
        needed = after.mean() > most and state.p_value(after, before) < state.settings.significance.level
        if not needed:
            return state.with_found(entries, fitted)
    return None
