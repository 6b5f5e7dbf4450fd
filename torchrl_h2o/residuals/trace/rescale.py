"""Scales residuals by their size with the effects found, and refits if that size fell much or start states changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.trace.eliminate import eliminate
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.noise_free import without_noise
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import MUCH_LOWER, SearchState

# relative step in a second fit, where the first one gained little: 1e-2 of a parameter's typical size
COARSE_STEP = 1e-3
# ratio of the residuals' scales, after and before an addition, below which the effects are fitted once more
MUCH_FINER = 0.2


def rescale(state: SearchState) -> SearchState:
    """Scales residuals by their present size.

    Refits once if the start states of observed coordinates have changed, or if the scale of the residuals has fallen
    much. With the larger scale, a fit stops early: its loss hardly changes although the residual is far above rounding.
    """
    posed = state.posed_at(state.fit.effects)
    rescaled, observed = state.rescaled(posed), posed.simulation.state_map.observations
    within_rounding = posed.within_rounding
    moved = not np.array_equal(observed(state.problem.states), observed(posed.states))
    sharper = _is_sharper(posed, state.problem, MUCH_FINER)
    if state.entries and not within_rounding and (moved or sharper):
        kept = eliminate(rescaled.with_found(state.entries, _refitted(rescaled, again=sharper)))
        posed = kept.posed_at(kept.fit.effects)
        rescaled, within_rounding = kept.rescaled(posed), posed.within_rounding
    return without_noise(replace(rescaled, exact=within_rounding))


def _refitted(state: SearchState, *, again: bool) -> Fit:
    """Refits the effects found.

    Contacts make the residual discontinuous, so small finite differences may miss the descent direction.

    Args:
        state: effects found.
        again: whether a first fit that gains little without sensor noise is repeated with larger differences.
    """
    start = state.fit.effects
    fitted = state.refitted(state.entries, start)
    gained = state.screened_loss(fitted.effects) < MUCH_LOWER * state.screened_loss(start)
    if gained or not again or state.problem.sensor_std is not None:
        return fitted
    coarse = state.refitted(state.entries, start, difference_step=COARSE_STEP)
    return min(fitted, coarse, key=lambda one: one.loss)


def _is_sharper(posed: Problem, before: Problem, much_finer: float) -> bool:
    """Whether the sensors turn out to have no noise, or the residuals' scale falls much in the median dimension."""
    if posed.sensor_std is None and before.sensor_std is not None:
        return True
    new, old = (np.median(one.scale, axis=(0, 1)) for one in (posed, before))
    return bool(np.median(new / old) < much_finer)
