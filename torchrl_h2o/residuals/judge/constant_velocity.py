"""Whether effects explain the motion, or only keep the joints from moving."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.effects import Effect, selection
from torchrl_h2o.residuals.judge.headline import VELOCITY_UNITS
from torchrl_h2o.residuals.measured.constant_velocity import ErrorsAhead, errors_ahead, explains_motion
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.words import duration, effect_words, quantity
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


def no_better_than_constant_velocity(
    mended: Simulation, measured: Measured, effects: Sequence[Effect], settings: LoopSettings = DEFAULTS
) -> tuple[str, ...]:
    """Says so if effects predict motion no better than the guess that every velocity stays as it is.

    Rotors so heavy that no torque moves them lower the error of a model without friction, if the motion is slow. Such
    effects explain nothing: they predict that the velocities do not change.

    Args:
        mended: the simulator with the effects found.
        measured: the data, of which the part for the report is used.
        effects: the effects; each is judged by the joints that it acts on.
        settings: times ahead, and the share of the guess's error up to which a prediction counts as better.

    Returns:
        One clause if most quantities are predicted no better at any time ahead. Otherwise one for each effect on
        joints all of whose quantities are predicted no better.
    """
    errors, most = errors_ahead(mended, measured, Split.REPORT, settings), settings.verdict.better_than_guess
    if not explains_motion(errors, most):
        everything = range(len(mended.state_map.names))
        return (f"they predict the motion {_hardly_better(mended, errors[0], everything)}",)
    clauses = []
    for effect in effects:
        own = _quantities_of_joints(mended, effect)
        known = [error for error in errors if own and np.isfinite(error.guessed[own]).any()]
        if known and min(float(np.nanmin(error.relative[own])) for error in known) > most:
            joints = f"with {effect_words(effect, mended.names)}, the motion of these joints is predicted"
            clauses.append(f"{joints} {_hardly_better(mended, known[0], own)}")
    return tuple(clauses)


def _hardly_better(mended: Simulation, error: ErrorsAhead, among: Sequence[int]) -> str:
    """The end of a clause, with the errors of the quantity with the median relative error; positions come first."""
    names, units, relative = mended.state_map.names, mended.state_map.units, error.relative
    known = [i for i in among if np.isfinite(error.guessed[i])]
    usual = np.median(relative[known])
    index = min(known, key=lambda i: (units[i] in VELOCITY_UNITS, abs(relative[i] - usual)))
    missed, guessed = (quantity(float(which[index]), units[index], 2) for which in (error.simulated, error.guessed))
    ahead = f"{names[index]} {duration(error.steps * mended.control_step)} ahead"
    return f"hardly better than by the guess that every velocity stays as it is ({ahead}: {missed} against {guessed})"


def _quantities_of_joints(simulation: Simulation, effect: Effect) -> list[int]:
    """Indices of the quantities that observe the joints of an effect; empty if it does not act on joints."""
    if (chosen := getattr(effect, "joints", None)) is None:
        return []
    model, observe = simulation.model, simulation.state_map.observe
    dofs = selection.joint_dofs(model, chosen)
    ends = np.append(model.jnt_qposadr, model.nq)
    positions = [at for joint in {model.dof_jntid[dof] for dof in dofs} for at in range(ends[joint], ends[joint + 1])]
    coordinates = [*positions, *(model.nq + dof for dof in dofs)]
    return [int(i) for i in np.flatnonzero((observe[:, coordinates] != 0.0).any(1))]
