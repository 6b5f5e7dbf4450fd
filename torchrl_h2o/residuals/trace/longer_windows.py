"""Longer windows where sensors are noisy: their length, and the last fit of the effects found."""

from __future__ import annotations

from dataclasses import replace

from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.trace.choose_horizon import enough_windows
from torchrl_h2o.residuals.trace.fit import Fit, fit
from torchrl_h2o.residuals.trace.problem import Problem


def longer_windows(problem: Problem, settings: LoopSettings = DEFAULTS) -> int | None:
    """Length of the longer windows, in control steps.

    Args:
        problem: simulation, data and windows of the search.
        settings: bounds of a window's length, and the number of windows that the data must hold.

    Returns:
        The length; None if the sensors have no noise, if the problem's windows are as long, or if the data hold too few
        longer ones.
    """
    rules, control_step = settings.longer_windows, problem.simulation.control_step
    steps = min(max(rules.steps, round(rules.seconds / control_step)), int(rules.longest / control_step))
    if problem.sensor_std is None or steps <= problem.horizon:
        return None
    return steps if enough_windows(problem.measured, steps, settings.horizon) else None


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
    rules, simulation, measured = settings.longer_windows, problem.simulation, problem.measured
    if (steps := longer_windows(problem, settings)) is None:
        return found
    starts = measured.fitted(steps)

    def posed_with(fitted: Fit) -> Problem:
        mended = simulation.with_effects(*fitted.effects)
        return replace(Problem.pose(mended, measured, steps, settings=problem.settings), simulation=simulation)

    at_first = posed_with(found)
    longer = fit(at_first, found.effects, found.free, starts, settings=settings.fit)
    for _ in range(rules.fits - 1):
        longer = fit(posed_with(longer), longer.effects, longer.free, starts, settings=settings.fit)
    better = at_first.selection_loss(longer.effects) < at_first.selection_loss(found.effects)
    return longer if better else found
