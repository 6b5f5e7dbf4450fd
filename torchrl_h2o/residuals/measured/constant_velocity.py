"""The guess that every velocity stays as it is: what a simulator has to predict better to explain any motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_h2o.effects import Effect, selection
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.residual import residuals, start_states, undelayed_following
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.simulation.simulation import Simulation

HEADLINE_SECONDS = (0.1, 0.2, 0.5, 1.0)  # times ahead, in s, from which that of the report's sentence is chosen
HEADLINE_WINDOWS = 8  # smallest number of held-out windows for such a time
NEGLIGIBLE_ERROR = 0.001  # median error, in spreads, below which a rise does not count
# median error ahead up to which effects explain the motion, in errors of the guess of constant velocities
BETTER_THAN_GUESS = 0.8


@dataclass(frozen=True, eq=False)
class ErrorsAhead:
    """Median errors at one time ahead, in the units of the observations.

    Args:
        steps: control steps ahead.
        simulated: (n), errors of a simulator.
        guessed: (n), errors of the guess that every velocity stays as it is.
        negligible: (n), error of the guess up to which nothing moves.
    """

    steps: int
    simulated: np.ndarray
    guessed: np.ndarray
    negligible: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """(n), errors of the simulator in errors of the guess; infinite where it diverges, NaN where none is known."""
        return self.simulated / np.maximum(self.guessed, self.negligible)


def errors_ahead(simulation: Simulation, measured: Measured, split: Split) -> list[ErrorsAhead]:
    """Errors of a simulator and of the guess at the times ahead of the report's sentence, in ascending order.

    Windows in which nothing moves are left out, because no simulator beats the guess there.

    Args:
        simulation: the simulator.
        measured: the data.
        split: part of the data.
    """
    errors = []
    states, following = start_states(simulation, measured), undelayed_following(simulation, measured)
    negligible = NEGLIGIBLE_ERROR * np.maximum(measured.observation.std(0), 1e-12)
    for steps in sorted({max(1, round(time / simulation.control_step)) for time in HEADLINE_SECONDS}):
        starts = in_motion(measured, measured.spread_windows(split, steps), steps, HEADLINE_WINDOWS)
        if len(starts) < HEADLINE_WINDOWS:
            continue
        missed = residuals(simulation, measured, starts, steps, states=states)[:, -1]
        wrong = following[starts + steps - 1] - at_constant_velocity(simulation, states[starts], steps)
        known = np.isfinite(wrong)  # late sensors leave the readings at the ends of runs unknown
        if known.any():
            diverged_too = np.where(np.isfinite(missed), np.abs(missed), np.inf)
            simulated, guessed = (_median(error, known) for error in (diverged_too, np.abs(wrong)))
            errors.append(ErrorsAhead(steps, simulated, guessed, negligible))
    return errors


def at_constant_velocity(simulation: Simulation, states: np.ndarray, steps: int) -> np.ndarray:
    """Observations, (W, n), some control steps after states (W, nq + nv), if the velocities stay as they are."""
    model, seconds = simulation.model, steps * simulation.control_step
    position, velocity = states[:, : model.nq].copy(), states[:, model.nq :]
    for qpos, qvel in zip(position, velocity, strict=True):
        mujoco.mj_integratePos(model, qpos, qvel, seconds)
    return simulation.observed(np.hstack([position, velocity])[:, None])[:, 0]


def explains_motion(errors: Sequence[ErrorsAhead], most: float) -> bool:
    """Whether most quantities are predicted better than by the guess, at one of the times ahead at least.

    Args:
        errors: of :func:`errors_ahead`.
        most: relative error up to which a prediction counts as better.

    Returns:
        The answer; True if the data hold enough windows for none of the times.
    """
    return not errors or min(float(np.nanmedian(error.relative)) for error in errors) <= most


def effects_on_unpredicted_joints(
    mended: Simulation, errors: Sequence[ErrorsAhead], effects: Sequence[Effect], most: float
) -> list[Effect]:
    """The effects on joints all of whose quantities are predicted no better than by the guess, at any time ahead.

    Args:
        mended: the simulator with the effects.
        errors: of :func:`errors_ahead`.
        effects: the effects; those that do not act on joints are left out.
        most: relative error up to which a prediction counts as better.
    """
    found = []
    for effect in effects:
        own = quantities_of_joints(mended, effect)
        known = [error for error in errors if is_known(error, own)]
        if known and min(float(np.nanmin(error.relative[own])) for error in known) > most:
            found.append(effect)
    return found


def is_known(error: ErrorsAhead, quantities: Sequence[int]) -> bool:
    """Whether the error of the guess is known for one of some quantities."""
    return bool(len(quantities)) and bool(np.isfinite(error.guessed[list(quantities)]).any())


def quantities_of_joints(simulation: Simulation, effect: Effect) -> list[int]:
    """Indices of the quantities that observe the joints of an effect; empty if it does not act on joints."""
    if (chosen := getattr(effect, "joints", None)) is None:
        return []
    model, observe = simulation.model, simulation.state_map.observe
    dofs = selection.joint_dofs(model, chosen)
    ends = np.append(model.jnt_qposadr, model.nq)
    positions = [at for joint in {model.dof_jntid[dof] for dof in dofs} for at in range(ends[joint], ends[joint + 1])]
    coordinates = [*positions, *(model.nq + dof for dof in dofs)]
    return [int(i) for i in np.flatnonzero((observe[:, coordinates] != 0.0).any(1))]


def _median(error: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Median of the known errors (W, n), (n); NaN where none is known."""
    return np.array(
        [np.median(column[rows]) if rows.any() else np.nan for column, rows in zip(error.T, known.T, strict=True)]
    )
