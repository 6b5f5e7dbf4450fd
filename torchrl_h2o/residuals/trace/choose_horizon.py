"""Chooses the window length of the search, and fits effects again in longer windows where sensors are noisy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.measured.error_over_noise import error_over_noise
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise
from torchrl_h2o.residuals.measured.transitions import Measured, thinned
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.fit import Fit, fit
from torchrl_h2o.residuals.trace.problem import Problem

JUDGED_WINDOWS = 100  # largest number of windows by which a length is judged
MIN_FITTED = 20  # smallest number of windows for fits that a length must leave
# smallest number of windows for the selection of effects that a length must leave. With fewer windows, no gain is
# significant after the level is divided by the number of effects tried
MIN_SELECTED = 16
# median error over the median error that sensor noise alone causes, beyond which no longer windows are tried
STANDS_OUT = 10.0
LEAST_RATIO = 1.5  # smallest such ratio of windows longer than one step; a smaller one is chance
# factor by which this ratio must grow to justify longer windows, which cost more and amplify contact errors
LONGER_GAIN = 1.2


def choose_horizon(
    simulation: Simulation,
    measured: Measured,
    rng: np.random.Generator,
    settings: LoopSettings = DEFAULTS,
) -> int:
    """Chooses how many control steps each window of the search has.

    With good sensors one step is enough. With noisy sensors a longer window helps: the error from a missing effect
    accumulates over the window, but the noise of the start state does so less. A slow effect, such as a loss of energy
    over minutes, shows only in long windows.

    Args:
        simulation: the simulator.
        measured: the data.
        rng: generator of synthetic noise.
        settings: lengths to choose from, and thresholds.

    Returns:
        Control steps per window.
    """
    sensor_std = sensor_noise(simulation, measured)
    if sensor_std is None:
        return 1
    best, most = 1, 0.0
    for horizon in possible_horizons(simulation, measured, settings):
        moving = in_motion(measured, measured.fitted(horizon), horizon, MIN_FITTED)
        starts = thinned(moving, JUDGED_WINDOWS)
        ratio = float(error_over_noise(simulation, measured, starts, horizon, sensor_std, rng).max())
        if horizon == 1 or ratio > max(LONGER_GAIN * most, LEAST_RATIO):
            best, most = horizon, ratio
        if ratio > STANDS_OUT:
            break
    return best


def possible_horizons(simulation: Simulation, measured: Measured, settings: LoopSettings) -> list[int]:
    """One control step and the lengths of the settings, in control steps, of which the data hold enough windows."""
    steps = sorted({1, *(round(seconds / simulation.control_step) for seconds in settings.window_seconds)} - {0})
    return [horizon for horizon in steps if horizon == 1 or enough_windows(measured, horizon)]


def enough_windows(measured: Measured, horizon: int) -> bool:
    """Whether data hold enough windows of a length, in control steps, for a fit and for a choice."""
    fitted, selected_on = measured.fitted(horizon), measured.selected_on(horizon)
    return len(fitted) >= MIN_FITTED and len(selected_on) >= MIN_SELECTED


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
