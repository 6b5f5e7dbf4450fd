"""Removes effects that are not needed, and swaps effects that do not commute."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from torchrl_h2o.effects import ActionEffect, ObservationEffect
from torchrl_h2o.residuals.trace.close_comparison import SAME_LOSS
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import MIN_GAIN, matters
from torchrl_h2o.residuals.trace.screening import free_parameters, is_possible
from torchrl_h2o.residuals.trace.state import SKETCH_EVALUATIONS, SearchState

# multiple of the loss that a sketch without an effect must exceed for the effect to be kept without a full fit
CLEARLY_NEEDED = 1.5


def eliminate(state: SearchState) -> SearchState:
    """Removes effects one by one as long as the held-out loss without one is not significantly higher."""
    while len(state.entries) > 1:
        smaller = _without_one(state)
        if smaller is None:
            return state
        state = smaller
    return state


def _is_clearly_needed(state: SearchState, index: int) -> bool:
    """Whether a quick fit of the other effects leaves a much higher loss; spares most of the full fits."""
    effects = state.fit.effects
    free = [free_parameters(entry) for i, entry in enumerate(state.entries) if i != index]
    without = state.sketched([e for i, e in enumerate(effects) if i != index], free, SKETCH_EVALUATIONS).loss
    return without > CLEARLY_NEEDED * state.screened_loss(effects)


def _without_one(state: SearchState) -> SearchState | None:
    """The state without the first effect that is not needed; None if all are needed."""
    before = state.selection_losses(state.fit.effects)
    for index in range(len(state.entries)):
        entries = (*state.entries[:index], *state.entries[index + 1 :])
        kept = (*state.fit.effects[:index], *state.fit.effects[index + 1 :])
        if not is_possible(state.problem, kept) or _is_clearly_needed(state, index):
            continue
        # the joint fit without the effect is a candidate as well: it is the better one if the effect has become neutral
        # and the new fit ends in a worse minimum
        fits = (state.refitted(entries, kept), state.fit.without(index))
        after, fitted = min(((state.selection_losses(one.effects), one) for one in fits), key=lambda one: one[0].mean())
        if not is_worse(state, fitted, before, after):
            return state.with_found(entries, fitted)
    return None


def is_worse(state: SearchState, smaller: Fit, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether fewer effects have a held-out loss that is significantly higher than that of the effects found.

    The difference must also exceed a minimum share of the loss, and what rounding explains.

    Args:
        state: effects found.
        smaller: fit of fewer effects.
        before: losses of the selection windows with the effects found, (W).
        after: those with fewer effects, (W).
    """
    most = before.mean() / (1.0 - MIN_GAIN)
    level = state.settings.level
    return bool(after.mean() > most and state.p_value(after, before) < level and _is_beyond_rounding(state, smaller))


def _is_beyond_rounding(state: SearchState, smaller: Fit) -> bool:
    """Whether a smaller fit misses a share of the first loss that rounding does not explain."""
    without, with_it = (state.first.selection_loss(which.effects) for which in (smaller, state.fit))
    return matters(state.first_loss, without, with_it, SAME_LOSS)


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
