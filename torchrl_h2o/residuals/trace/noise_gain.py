"""Measures how much of a loss a fit explains where sensor noise is the only difference from the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.measured.sensor_noise import stand_in
from torchrl_h2o.residuals.trace.fit import Free, fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState


def explained_by_noise(
    state: SearchState, effects: Sequence[Effect], free: Sequence[Free], rng: np.random.Generator
) -> float:
    """Share of the loss that effects explain in synthetic data, in which the effects found so far are the truth.

    Args:
        state: effects found so far.
        effects: other effects, with the values of their fit to the measured data. The fit to the synthetic data starts
            from them, because noise alone may have a minimum near them.
        free: names of the parameters to fit, for each effect.
        rng: generator of the sensor noise.

    Returns:
        The share; 0 if the sensors have no noise.
    """
    problem = state.problem
    if problem.sensor_std is None:
        return 0.0
    mended = problem.simulation.with_effects(*state.fit.effects)
    data = stand_in(mended, problem.measured, problem.sensor_std, rng, problem.horizon, problem.states)
    posed = Problem.pose(mended, data, problem.horizon, sensor_std=problem.sensor_std)
    posed = replace(posed, simulation=problem.simulation)
    fitted = fit(posed, effects, free, state.windows.fitted, max_evaluations=state.settings.max_evaluations)
    before, after = (posed.selection_loss(which) for which in (state.fit.effects, fitted.effects))
    return 1.0 - after / before
