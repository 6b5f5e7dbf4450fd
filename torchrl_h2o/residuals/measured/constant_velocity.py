"""The guess that every velocity stays as it is: what a simulator has to predict better to explain any motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.measured.transitions import Measured, Split, thinned
from torchrl_h2o.residuals.simulation.simulation import Simulation


def median_errors(
    simulation: Simulation, measured: Measured, starts: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Median errors at the end of windows, of a simulator and of the guess that every velocity stays as it is.

    Args:
        simulation: the simulator.
        measured: the data.
        starts: (W), first row of each window.
        steps: control steps per window.

    Returns:
        Two arrays (n), in the units of the observations.
    """
    states = start_states(simulation, measured, starts)
    missed = np.abs(residuals(simulation, measured, starts, steps, states=states)[:, -1])
    guess = at_constant_velocity(simulation, states[starts], steps)
    guessed = np.abs(measured.following[starts + steps - 1] - guess)
    return np.nanmedian(missed, axis=0), np.nanmedian(guessed, axis=0)


def at_constant_velocity(simulation: Simulation, states: np.ndarray, steps: int) -> np.ndarray:
    """Observations, (W, n), some control steps after states (W, nq + nv), if the velocities stay as they are."""
    model, seconds = simulation.model, steps * simulation.control_step
    position, velocity = states[:, : model.nq].copy(), states[:, model.nq :]
    for qpos, qvel in zip(position, velocity, strict=True):
        mujoco.mj_integratePos(model, qpos, qvel, seconds)
    return simulation.observed(np.hstack([position, velocity])[:, None])[:, 0]


def share_of_guess(simulation: Simulation, measured: Measured, starts: np.ndarray, steps: int) -> np.ndarray:
    """Median error of a simulator in median errors of the guess, (n); see :func:`median_errors`.

    Errors of the guess below a thousandth of a quantity's spread count as this thousandth.
    """
    missed, guessed = median_errors(simulation, measured, starts, steps)
    return missed / np.maximum(guessed, 1e-3 * np.maximum(measured.observation.std(0), 1e-12))


def shares_of_guess(
    simulation: Simulation, measured: Measured, split: Split, seconds: Sequence[float], least: int
) -> dict[int, np.ndarray]:
    """The shares (n) at several times ahead, by control steps; see :func:`share_of_guess`.

    Args:
        simulation: the simulator.
        measured: the data.
        split: part of the data.
        seconds: times ahead, in s.
        least: smallest number of windows; times with fewer are left out.
    """
    shares = {}
    for steps in sorted({max(1, round(time / simulation.control_step)) for time in seconds}):
        starts = thinned(measured.windows(steps, steps, split=split), measured.settings.max_windows)
        if len(starts) >= least:
            shares[steps] = share_of_guess(simulation, measured, starts, steps)
    return shares


def explains_motion(shares: Mapping[int, np.ndarray], most: float) -> bool:
    """Whether most quantities are predicted better than by the guess at one of the times ahead; True without times.

    Args:
        shares: of :func:`shares_of_guess`.
        most: share up to which a prediction counts as better.
    """
    return not shares or min(float(np.median(share)) for share in shares.values()) <= most
