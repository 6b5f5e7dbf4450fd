"""Longer windows where sensors are noisy: their length, and the last fit of the effects found."""

from __future__ import annotations

from dataclasses import replace

from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.trace.choose_horizon import enough_windows
from torchrl_h2o.residuals.trace.fit import Fit, fit
from torchrl_h2o.residuals.trace.problem import Problem

FITS = 3  # fits, each with states estimated with the values of the one before
LEAST_STEPS = 10  # smallest number of control steps per window
LEAST_SECONDS = 0.1  # smallest length of a window, in s
MOST_SECONDS = 0.2  # largest length of a window, in s; it may have fewer control steps then


def longer_windows(problem: Problem) -> int | None:
    """Length of the longer windows, in control steps.

    Args:
        problem: simulation, data and windows of the search.

    Returns:
        The length; None if the sensors have no noise, if the problem's windows are as long, or if the data hold too few
        longer ones.
    """
    control_step = problem.simulation.control_step
    steps = min(max(LEAST_STEPS, round(LEAST_SECONDS / control_step)), int(MOST_SECONDS / control_step))
    if problem.sensor_std is None or steps <= problem.horizon:
        return None
    return steps if enough_windows(problem.measured, steps) else None


def fitted_in_longer_windows(problem: Problem, found: Fit, settings: LoopSettings = DEFAULTS) -> Fit:
    """Fits effects again in longer windows, with states that are estimated with these effects.

    In windows of one step, the values depend on the values with which the states were estimated. Dry friction shows
    this: it acts where a velocity changes its sign, and the estimated states decide when that is. In longer windows,
    the motion after the start decides.

    Args:
        problem: simulation without the effects, data and scales of the residuals.
        found: the effects, fitted in windows of the problem's length.
        settings: number of the fits, and length of their windows.

    Returns:
        The fit in longer windows; the given one if there are no longer windows, or if the values predict the selection
        part no better in them.
    """
    simulation, measured = problem.simulation, problem.measured
    if (steps := longer_windows(problem)) is None:
        return found
    starts = measured.fitted(steps)

    def posed_with(fitted: Fit) -> Problem:
        mended = simulation.with_effects(*fitted.effects)
        return replace(Problem.pose(mended, measured, steps), simulation=simulation)

    at_first = posed_with(found)
    longer = fit(at_first, found.effects, found.free, starts, max_evaluations=settings.max_evaluations)
    for _ in range(FITS - 1):
        longer = fit(posed_with(longer), longer.effects, longer.free, starts, max_evaluations=settings.max_evaluations)
    better = at_first.selection_loss(longer.effects) < at_first.selection_loss(found.effects)
    return longer if better else found
