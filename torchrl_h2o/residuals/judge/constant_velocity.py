"""Whether a simulator predicts the motion better than the guess that every velocity stays as it is."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.errors import HeadlineError
from torchrl_h2o.residuals.report.words import duration, quantity
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


def no_better_than_constant_velocity(
    mended: Simulation, measured: Measured, head: HeadlineError, settings: LoopSettings = DEFAULTS
) -> tuple[str, ...]:
    """Says so if most quantities are predicted as well by the guess that every velocity stays as it is.

    Rotors so heavy that no torque moves them lower the error of a model without friction, if the motion is slow. Such
    effects explain nothing: their prediction is that the velocities do not change.

    Args:
        mended: the simulator with the effects found.
        measured: the data, of which the part for the report is used.
        head: the error of the report's sentence, for its time.
        settings: the share of the guess's error that counts as better.

    Returns:
        One clause, or nothing.
    """
    steps = max(1, round(head.seconds / mended.control_step))
    starts = measured.reported_on(steps)
    errors = np.abs(residuals(mended, measured, starts, steps)[:, -1])
    guessed = np.abs(measured.following[starts + steps - 1] - at_constant_velocity(mended, measured, starts, steps))
    spread = np.maximum(measured.observation.std(0), 1e-12)
    median, guess = (np.nanmedian(error, axis=0) / spread for error in (errors, guessed))
    share = median / np.maximum(guess, settings.verdict.worse_negligible)
    if not np.median(share) > settings.verdict.better_than_guess:
        return ()
    index = int(np.abs(share - np.median(share)).argmin())
    name, unit = mended.state_map.names[index], mended.state_map.units[index]
    missed, by_guess = (quantity(float(value[index] * spread[index]), unit, 2) for value in (median, guess))
    return (
        f"they predict the motion hardly better than the guess that every velocity stays as it is ({name} "
        f"{duration(head.seconds)} ahead: {missed} against {by_guess})",
    )


def at_constant_velocity(simulation: Simulation, measured: Measured, starts: np.ndarray, steps: int) -> np.ndarray:
    """Observations, (W, n), if the velocities at the start of each window last until its end.

    Args:
        simulation: simulator with the state map.
        measured: the data.
        starts: (W), first row of each window.
        steps: control steps per window.
    """
    states, model = start_states(simulation, measured, starts)[starts], simulation.model
    position, velocity = states[:, : model.nq].copy(), states[:, model.nq :]
    for row in range(len(starts)):
        mujoco.mj_integratePos(model, position[row], velocity[row], steps * simulation.control_step)
    return simulation.observed(np.hstack([position, velocity])[:, None])[:, 0]
