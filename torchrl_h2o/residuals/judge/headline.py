"""The error that the report's sentence names: one quantity, some time ahead, before and after."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.estimated_states import sensor_noise
from torchrl_h2o.residuals.measured.error_over_noise import error_over_noise
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured, thinned
from torchrl_h2o.residuals.report.errors import HeadlineError
from torchrl_h2o.residuals.simulation.simulation import Simulation

HEADLINE_SECONDS = (0.1, 0.2, 0.5, 1.0)  # times ahead, in s, from which that of the report's sentence is chosen
HEADLINE_WINDOWS = 8  # smallest number of held-out windows for such a time
HEADLINE_LEAST = 1.5  # median error over that by noise alone from which a quantity may be the sentence's
HEADLINE_STANDS_OUT = 3.0  # median error over the median error by sensor noise at which the sentence's time is chosen
NOISE_WINDOWS = 100  # largest number of windows by which that time is chosen

VELOCITY_UNITS = ("rad/s", "m/s")


def headline_horizon(simulation: Simulation, measured: Measured) -> int | None:
    """Control steps ahead at which the report's sentence gives the error; None if the data hold too few windows.

    The shortest of the possible times at which the simulator's error exceeds the sensors' noise by a factor, on the
    part of the data for fits; the longest possible time if it never does.

    Args:
        simulation: the simulator before effects are put in.
        measured: the data.
    """
    sensor_std, rng = sensor_noise(simulation, measured), np.random.default_rng(0)
    chosen = None
    for seconds in HEADLINE_SECONDS:
        steps = max(1, round(seconds / simulation.control_step))
        if len(measured.reported_on(steps)) < HEADLINE_WINDOWS:
            break
        chosen, starts = steps, _fitted_in_motion(measured, steps)
        if sensor_std is None or not len(starts):
            break
        if error_over_noise(simulation, measured, starts, steps, sensor_std, rng).max() > HEADLINE_STANDS_OUT:
            break
    return chosen


def headline_error(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    steps: int,
) -> HeadlineError:
    """The median error some steps ahead of the quantity in which it is largest, in units of the quantity's spread.

    The median is over the windows in which something moves. A position is preferred to a velocity, because it is
    easier to picture. Quantities whose error is that of their sensor, such as the angle of a body that does not turn,
    are left out if there are others.

    Args:
        simulation: the simulator before effects are put in.
        mended: the simulator with them.
        measured: the data.
        steps: control steps ahead.
    """
    starts = in_motion(measured, measured.reported_on(steps), steps, HEADLINE_WINDOWS)
    before, after = (_median(which, measured, starts, steps) for which in (simulation, mended))
    names, units = simulation.state_map.names, simulation.state_map.units
    spread = np.maximum(measured.observation.std(0), 1e-12)
    positions = np.array([unit not in VELOCITY_UNITS for unit in units])
    beyond_noise = _beyond_noise(simulation, measured, steps)
    choices = (positions & beyond_noise, beyond_noise, positions, np.ones_like(positions))
    chosen = next(which for which in choices if which.any())
    index = int(np.where(chosen, before / spread, -1.0).argmax())
    return HeadlineError(
        names[index], units[index], steps * simulation.control_step, float(before[index]), float(after[index])
    )


def _beyond_noise(simulation: Simulation, measured: Measured, steps: int) -> np.ndarray:
    """Quantities whose error, on the part of the data for fits, clearly exceeds what sensor noise causes, (n,)."""
    sensor_std, starts = sensor_noise(simulation, measured), _fitted_in_motion(measured, steps)
    if sensor_std is None or not len(starts):
        return np.ones(len(simulation.state_map.names), bool)
    ratio = error_over_noise(simulation, measured, starts, steps, sensor_std, np.random.default_rng(0))
    return ratio > HEADLINE_LEAST


def _fitted_in_motion(measured: Measured, steps: int) -> np.ndarray:
    """First rows of windows for fits in which something moves, thinned to ``NOISE_WINDOWS``."""
    starts = in_motion(measured, measured.fitted(steps), steps, HEADLINE_WINDOWS)
    return thinned(starts, NOISE_WINDOWS)


def _median(simulation: Simulation, measured: Measured, starts: np.ndarray, steps: int) -> np.ndarray:
    # the simulator's own action noise is drawn, because it is part of the simulator's error
    missed = residuals(simulation, measured, starts, steps, rng=np.random.default_rng(0))[:, -1]
    return np.nanmedian(np.abs(missed), axis=0)
