"""What a log does not hold: unobserved coordinates, activations of actuators, and what effects remember."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.residuals.measured.transitions import SETTLING_STEPS, Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

SETTLED_ROWS = 50  # largest number of successive rows that share a simulation of the unobserved coordinates


def settle(
    simulation: Simulation, measured: Measured, states: np.ndarray, actions: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Replaces the unobserved coordinates in some rows by those that a simulation along the data reaches.

    Args:
        simulation: the simulator.
        measured: the data.
        states: (T, nq + nv), the observed coordinates, and values from which the unobserved ones begin.
        actions: (T, nu), executed actions.
        rows: (W), rows in which unobserved coordinates are needed.

    Returns:
        The states, (T, nq + nv); ``states`` itself if the simulator has no such coordinates.
    """
    hidden = simulation.state_map.hidden
    if not len(hidden) or not len(rows):
        return states
    found, (reached, after, _) = states.copy(), _followed(simulation, measured, states, actions, rows, hidden)
    found[reached[:, None], list(hidden)] = after
    return found


def activations(
    simulation: Simulation,
    measured: Measured,
    actions: np.ndarray,
    states: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> np.ndarray:
    """Activations of the actuators before each row, run by run, and what effects remember, (T, na + r).

    Args:
        simulation: the simulator.
        measured: the data.
        actions: (T, nu), executed actions.
        states: (T, nq + nv), states along which effects remember something; without them, this is left out.
        rows: (W), rows in which it is needed; in others it is NaN.
    """
    if simulation.model.na:
        active = np.concatenate([simulation.activations(actions[run]) for run in measured.runs])
    else:
        active = np.zeros((len(measured), 0))
    if states is None or rows is None or not len(rows) or not simulation.num_remembered:
        return active
    memory = np.full((len(measured), simulation.num_remembered), np.nan)
    reached, _, remembered = _followed(simulation, measured, states, actions, rows, ())
    memory[reached] = remembered
    return np.hstack([active, memory])


def _followed(
    simulation: Simulation,
    measured: Measured,
    states: np.ndarray,
    actions: np.ndarray,
    rows: np.ndarray,
    carried: Sequence[int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulations along the data, from some steps before the first row that each is for to the rows after it.

    All simulations run side by side. Before the start of a run, its first row is repeated.

    Returns:
        Rows, (R), and in each the ``carried`` coordinates, (R, c), and what effects remember, (R, r).
    """
    begins = np.concatenate([np.full(run.stop - run.start, run.start) for run in measured.runs])
    first, last = _chains(np.unique(rows), begins, SETTLING_STEPS, SETTLED_ROWS)
    steps = np.arange(-SETTLING_STEPS, (last - first).max())[:, None]
    path = np.clip(first + steps, begins[first], last)
    before = activations(simulation, measured, actions)[path]
    after, memory = simulation.follow(states[path], actions[path], measured.time[path], before, carried)
    reached = (steps >= -1) & (first + steps < last)
    return (first + steps + 1)[reached], after[reached], memory[reached]


def _chains(rows: np.ndarray, begins: np.ndarray, far: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last row, (C), of each simulation for sorted rows: few successive rows of one run.

    Args:
        rows: (W), sorted rows.
        begins: (T), first row of each row's run.
        far: distance of two rows beyond which they do not share a simulation.
        most: largest number of rows from the first to the last one.
    """
    opens = np.ones(len(rows), bool)
    opens[1:] = (np.diff(rows) > far) | (begins[rows[1:]] != begins[rows[:-1]])
    since = rows - rows[np.maximum.accumulate(np.where(opens, np.arange(len(rows)), 0))]
    opens[1:] |= np.diff(since // most) != 0
    closes = np.append(opens[1:], True)
    return rows[opens], rows[closes]
