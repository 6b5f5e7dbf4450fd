"""The residual: the measured observation minus the simulated one, from the same state and the same actions."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.measured.settling import activations, settle
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation


def residuals(
    simulation: Simulation,
    measured: Measured,
    starts: np.ndarray,
    horizon: int = 1,
    *,
    states: np.ndarray | None = None,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Computes residuals over windows, each simulated from its own start state.

    Args:
        simulation: the simulator.
        measured: the data.
        starts: (W), first row of each window.
        horizon: control steps per window.
        states: (T, nq + nv), start states; the measured ones by default.
        rng: generator for random action effects; without it they are left out.

    Returns:
        (W, H, n), in the units of the observations; NaN where the simulation diverges.
    """
    if states is None:
        states = start_states(simulation, measured, starts)
    rows = starts[:, None] + np.arange(horizon)
    actions = executed_actions(simulation, measured, rng)
    reached = simulation.rollout(
        states[starts],
        actions[rows],
        time=measured.time[starts],
        activations=activations(simulation, measured, actions, states, starts)[starts],
    )
    return undelayed_following(simulation, measured)[rows] - simulation.observed(reached)


def start_states(simulation: Simulation, measured: Measured, rows: np.ndarray | None = None) -> np.ndarray:
    """Measured states, (T, nq + nv): observed coordinates from the state map, unobserved ones from simulation.

    Args:
        simulation: simulator with the state map and the observation effects to undo.
        measured: the data.
        rows: (W), rows in which unobserved coordinates are needed; all by default.
    """
    true = np.concatenate([simulation.true_observations(measured.observation[run]) for run in measured.runs])
    rows = np.arange(len(measured)) if rows is None else rows
    return settle(simulation, measured, simulation.state_map.states(true), executed_actions(simulation, measured), rows)


def executed_actions(simulation: Simulation, measured: Measured, rng: np.random.Generator | None = None) -> np.ndarray:
    """Actions after the action effects, (T, nu), run by run; random effects are left out without a generator."""
    return np.concatenate([simulation.executed(measured.action[run], rng) for run in measured.runs])


def undelayed_following(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Following observations, (T, n), with the delays of the sensors undone."""
    observation, following = measured.observation, measured.following
    return np.concatenate(
        [simulation.undelayed(np.vstack([observation[run][:1], following[run]]))[1:] for run in measured.runs]
    )
