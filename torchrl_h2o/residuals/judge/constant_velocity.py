"""Whether effects explain the motion, or only keep the joints from moving."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.judge.headline import VELOCITY_UNITS
from torchrl_h2o.residuals.measured.constant_velocity import explains_motion, median_errors, shares_of_guess
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.words import duration, quantity
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


def no_better_than_constant_velocity(
    mended: Simulation, measured: Measured, settings: LoopSettings = DEFAULTS
) -> tuple[str, ...]:
    """Says so if most quantities are predicted as well by the guess that every velocity stays as it is.

    Rotors so heavy that no torque moves them lower the error of a model without friction, if the motion is slow. Such
    effects explain nothing: they predict that the velocities do not change.

    Args:
        mended: the simulator with the effects found.
        measured: the data, of which the part for the report is used.
        settings: times ahead, and the share of the guess's error up to which a prediction counts as better.

    Returns:
        One clause, or nothing if the prediction is better at any of these times ahead.
    """
    rules, seconds = settings.judge, settings.judge.headline_seconds
    shares = shares_of_guess(mended, measured, Split.REPORT, seconds, rules.headline_windows)
    if explains_motion(shares, settings.verdict.better_than_guess):
        return ()
    steps, share = min(shares.items())
    units = mended.state_map.units
    # a position is easier to picture than a velocity
    order = sorted(range(len(share)), key=lambda i: (units[i] in VELOCITY_UNITS, abs(share[i] - np.median(share))))
    index, unit = order[0], units[order[0]]
    errors = median_errors(mended, measured, measured.reported_on(steps), steps)
    missed, guessed = (quantity(float(error[index]), unit, 2) for error in errors)
    return (
        "they predict the motion hardly better than the guess that every velocity stays as it is "
        f"({mended.state_map.names[index]} {duration(steps * mended.control_step)} ahead: {missed} against {guessed})",
    )
