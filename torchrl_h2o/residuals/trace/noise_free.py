"""Tests whether what looks like sensor noise is an error of the effects found so far."""

from __future__ import annotations

from dataclasses import replace

from torchrl_h2o.residuals.trace.screening import free_parameters
from torchrl_h2o.residuals.trace.state import SKETCH_EVALUATIONS, SearchState

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
