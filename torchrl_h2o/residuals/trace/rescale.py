"""Scales residuals by their size with the effects found, and refits if that size fell much or start states changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.trace.eliminate import eliminate
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import free_parameters
from torchrl_h2o.residuals.trace.state import MUCH_LOWER, SKETCH_EVALUATIONS, SearchState

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


# share of the loss to which a refit or one more effect must lower it, or the sensors are taken to be noisy
NOISE_FREE_LOSS = 0.5
NOISE_FREE_FITS = 4  # largest number of such fits, each with residuals scaled anew, that may leave only rounding


def without_noise(state: SearchState) -> SearchState:
    """Fits the effects found as if the sensors had no noise, and keeps that fit if only rounding remains.

    A wrong gain or bias of a sensor enters successive residuals with opposite signs, as noise does. Start states that
    are filtered for such noise hide a part of the error, and the fitted gain is then too close to 1.

    Args:
        state: effects found, with residuals scaled by their present size.

    Returns:
        The state with the exact fit; unchanged if the sensors have noise or an effect is missing.
    """
    if state.exact or not state.entries or state.problem.sensor_std is None:
        return state
    no_noise = state.problem.measured.no_noise
    silent = state.rescaled(state.posed_at(state.fit.effects, sensor_std=no_noise))
    free = [free_parameters(entry) for entry in state.entries]
    fitted = silent.sketched(state.fit.effects, free, SKETCH_EVALUATIONS)
    if fitted.loss > NOISE_FREE_LOSS * silent.screened_loss(state.fit.effects):
        return state
    for _ in range(NOISE_FREE_FITS):
        silent = silent.with_found(state.entries, silent.refitted(state.entries, fitted.effects))
        fitted, posed = silent.fit, state.posed_at(silent.fit.effects, sensor_std=no_noise)
        silent = silent.rescaled(posed)
        if posed.within_rounding:
            return replace(silent, exact=True)
    return state
