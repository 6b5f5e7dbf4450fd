"""Whether effects explain the motion, or only keep the joints from moving."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.judge.headline import VELOCITY_UNITS
from torchrl_h2o.residuals.measured.constant_velocity import (
    BETTER_THAN_GUESS,
    ErrorsAhead,
    effects_on_unpredicted_joints,
    errors_ahead,
    explains_motion,
    is_known,
    quantities_of_joints,
)
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.sentence import effects_in_words
from torchrl_h2o.residuals.report.words import duration, quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation


def no_better_than_constant_velocity(
    mended: Simulation, measured: Measured, effects: Sequence[Effect]
) -> tuple[str, ...]:
    """Says so if effects predict motion no better than the guess that every velocity stays as it is.

    Rotors so heavy that no torque moves them lower the error of a model without friction, if the motion is slow. Such
    effects explain nothing: they predict that the velocities do not change.

    Args:
        mended: the simulator with the effects found.
        measured: the data, of which the part for the report is used.
        effects: the effects; each is judged by the joints that it acts on.

    Returns:
        One clause if most quantities are predicted no better at any time ahead, or about the effects on joints all of
        whose quantities are predicted no better.
    """
    errors, most = errors_ahead(mended, measured, Split.REPORT), BETTER_THAN_GUESS
    if not explains_motion(errors, most):
        everything = range(len(mended.state_map.names))
        return (f"the effects found predict the motion {_hardly_better(mended, errors[0], everything)}",)
    unpredicted = effects_on_unpredicted_joints(mended, errors, effects, most)
    if not unpredicted:
        return ()
    own = sorted({index for effect in unpredicted for index in quantities_of_joints(mended, effect)})
    known = next(error for error in errors if is_known(error, own))
    words = effects_in_words(unpredicted, mended.names)
    return (f"with {words}, the motion of these joints is predicted {_hardly_better(mended, known, own)}",)


def _hardly_better(mended: Simulation, error: ErrorsAhead, among: Sequence[int]) -> str:
    """The end of a clause, with the errors of the quantity with the median relative error; positions come first."""
    names, units, relative = mended.state_map.names, mended.state_map.units, error.relative
    known = [i for i in among if np.isfinite(error.guessed[i])]
    usual = np.median(relative[known])
    index = min(known, key=lambda i: (units[i] in VELOCITY_UNITS, abs(relative[i] - usual)))
    missed, guessed = (quantity(float(which[index]), units[index], 2) for which in (error.simulated, error.guessed))
    ahead = f"{names[index]} {duration(error.steps * mended.control_step)} ahead"
    return f"hardly better than by the guess that every velocity stays as it is ({ahead}: {missed} against {guessed})"
