"""The residual: what was measured minus what the simulator makes of the same state and the same actions."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

_SETTLING = 12  # control steps in which what is hidden follows from what is not


def residuals(
    simulation: Simulation,
    measured: Measured,
    starts: np.ndarray,
    horizon: int = 1,
    *,
    states: np.ndarray | None = None,
    applied: np.ndarray | None = None,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Residuals over windows that each start from their own measured state.

    Args:
        simulation: the simulator.
        measured: the data.
        starts: (W), the first row of each window.
        horizon: control steps a window.
        states: (T, nq + nv), to start from instead of the measured ones.
        applied: (W, H, nv), generalised forces in N or N·m beside those of the effects.
        rng: draws the noise of random effects of the action, which are left out without it.

    Returns:
        (W, H, n), in the units of the observations; NaN where the simulation diverges.
    """
    if states is None:
        states = start_states(simulation, measured, starts)
    rows = starts[:, None] + np.arange(horizon)
    reached = simulation.rollout(
        states[starts], executed_actions(simulation, measured, rng)[rows], time=measured.time[starts], applied=applied
    )
    return _undelayed(simulation, measured)[rows] - simulation.observed(reached)


def start_states(simulation: Simulation, measured: Measured, rows: np.ndarray | None = None) -> np.ndarray:
    """The measured states, (T, nq + nv): observations through the state map, what is hidden carried along.

    What is hidden takes steps to follow. It is right in all rows, or in those that are asked for.
    """
    state_map = simulation.state_map
    true = np.concatenate([simulation.true_observations(measured.observation[run]) for run in measured.runs])
    states = state_map.states(true)
    if state_map.hidden:
        rows = np.arange(len(measured)) if rows is None else rows
        states[np.ix_(rows, state_map.hidden)] = _settled(simulation, measured, states, rows)
    return states


def _settled(simulation: Simulation, measured: Measured, states: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """What is hidden in some rows, (W, hidden): simulated from steps before, with all else as measured at each."""
    hidden = list(simulation.state_map.hidden)
    actions = executed_actions(simulation, measured)
    first = np.maximum(rows - _SETTLING, 0)
    # where a run begins, its first row is repeated
    begins = np.concatenate([np.full(run.stop - run.start, run.start) for run in measured.runs])[rows]
    carried = states[np.ix_(rows, hidden)]
    for step in range(_SETTLING):
        row = np.maximum(first + step, begins)
        now = states[row]
        now[:, hidden] = carried
        carried = simulation.rollout(now, actions[row][:, None], time=measured.time[row])[:, 0, hidden]
    return carried


def executed_actions(simulation: Simulation, measured: Measured, rng: np.random.Generator | None = None) -> np.ndarray:
    """What is executed of the measured actions, (T, nu), run by run; without a generator, of random effects nothing."""
    return np.concatenate([simulation.executed(measured.action[run], rng) for run in measured.runs])


def _undelayed(simulation: Simulation, measured: Measured) -> np.ndarray:
    """The following observations, (T, n), at the time at which they were true."""
    observation, following = measured.observation, measured.following
    return np.concatenate(
        [simulation.undelayed(np.vstack([observation[run][:1], following[run]]))[1:] for run in measured.runs]
    )
