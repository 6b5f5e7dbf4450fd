"""Estimates unobserved coordinates by simulation, with the observed ones reset to the measured values at every step."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.settings import MeasuredSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


def settled_coordinates(
    simulation: Simulation,
    states: np.ndarray,
    actions: np.ndarray,
    rows: np.ndarray,
    begins: np.ndarray,
    *,
    time: np.ndarray,
    settings: MeasuredSettings,
) -> np.ndarray:
    """Simulates the unobserved coordinates up to some rows.

    A simulation begins ``settling_steps`` rows before the first row that it is for, with the coordinates that the state
    map puts in, and goes on to the rows after it. All simulations run side by side.

    Args:
        simulation: the simulator.
        states: (T, nq + nv), with the measured values of the observed coordinates.
        actions: (T, nu), executed actions.
        rows: (W), the rows.
        begins: (T), first row of each row's run, which is repeated before the start of the run.
        time: (T), in s.
        settings: lengths of the simulations.

    Returns:
        (W, hidden), in the order of the state map's ``hidden``.
    """
    hidden = np.asarray(simulation.state_map.hidden)
    needed, places = np.unique(rows, return_inverse=True)
    first, last = _chains(needed, begins, settings)
    carried, found = states[np.ix_(first, hidden)], np.zeros((len(states), len(hidden)))
    for step in range(-settings.settling_steps, int((last - first).max(initial=0))):
        going = first + step < last
        row = np.maximum(first + step, begins[first])[going]
        now = states[row]
        now[:, hidden] = carried[going]
        reached = simulation.rollout(now, actions[row][:, None], time=time[row])[:, 0, hidden]
        diverged = ~np.isfinite(reached).all(1)
        reached[diverged] = states[np.ix_(row[diverged], hidden)]  # begins anew, or all later rows would diverge too
        carried[going] = reached
        if step >= -1:
            found[(first + step + 1)[going]] = reached
    return found[needed][places]


def _chains(rows: np.ndarray, begins: np.ndarray, settings: MeasuredSettings) -> tuple[np.ndarray, np.ndarray]:
    """First and last row, (C), of each simulation for sorted rows: few successive rows of one run."""
    far = np.diff(rows) > settings.settling_steps
    opens = np.concatenate([[True], far | (begins[rows[1:]] != begins[rows[:-1]])])[: len(rows)]
    since = rows - rows[np.maximum.accumulate(np.where(opens, np.arange(len(rows)), 0))]
    part = since // settings.settled_rows
    opens[1:] |= part[1:] != part[:-1]
    closes = np.concatenate([opens[1:], [True]])[: len(rows)]
    return rows[opens], rows[closes]
