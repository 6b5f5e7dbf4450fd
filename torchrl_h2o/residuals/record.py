"""A log as the states of a simulation: readings without the sensors' effects, and unobserved coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from torchrl_h2o.effects import ObservationEffect
from torchrl_h2o.residuals.measured.residual import executed_actions
from torchrl_h2o.residuals.measured.settling import activations, settle
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.simulation.simulation import Simulation

DERIVATIVE_ROWS = 7  # rows from which an unobserved velocity is computed: a parabola through the positions
STILL = 1e-12  # standard deviation below which a coordinate counts as constant

# numbers, because a type read from a model is in no tuple of members of the enumeration
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True, eq=False)
class Record:
    """A log as states of a simulation.

    The coordinates of a record are the n readings, followed by what no sensor reads: columns that were estimated from
    others, such as velocities from positions, and unobserved coordinates that affect later readings.

    Args:
        simulation: the simulator with its effects.
        measured: the log.
        rows: rows in which coordinates are needed that a simulation along the data reaches, (W); all by default.
    """

    simulation: Simulation
    measured: Measured
    rows: np.ndarray | None = None

    @property
    def num_readings(self) -> int:
        """n, the number of readings."""
        return len(self.seen)

    @cached_property
    def seen(self) -> np.ndarray:
        """Indices of the columns that sensors read, (n): those estimated from others say nothing new."""
        std = self.measured.estimated_std
        return np.flatnonzero(std == 0.0) if std is not None else np.arange(len(self.simulation.state_map.names))

    @cached_property
    def executed(self) -> np.ndarray:
        """Actions after the action effects, (T, nu)."""
        return executed_actions(self.simulation, self.measured)

    @cached_property
    def activations(self) -> np.ndarray:
        """Activations of the actuators, and what effects remember, (T, na + r)."""
        rows = np.arange(len(self.measured)) if self.rows is None else self.rows
        return activations(self.simulation, self.measured, self.executed, self.states[0], rows)

    @cached_property
    def readings(self) -> tuple[np.ndarray, np.ndarray]:
        """Readings before and after each step without the effects of the sensors, each (T, n)."""
        return true_readings(self.simulation, self.measured)

    @cached_property
    def into_state(self) -> np.ndarray:
        """(nq + nv, m): the change of the state by each coordinate."""
        state_map = self.simulation.state_map
        hidden = np.eye(len(state_map.offset))[:, list(state_map.hidden)]
        return np.hstack([state_map.restore_observed[:, self._columns], hidden])

    @cached_property
    def from_state(self) -> np.ndarray:
        """(m, nq + nv): the coordinates of a state."""
        state_map = self.simulation.state_map
        hidden = np.eye(len(state_map.offset))[list(state_map.hidden)]
        return np.vstack([state_map.observe[self._columns], hidden])

    @property
    def _columns(self) -> np.ndarray:
        """Indices of the columns, those first that sensors read."""
        return np.append(self.seen, np.delete(np.arange(len(self.simulation.state_map.names)), self.seen))

    @cached_property
    def positions_of_velocities(self) -> dict[int, int]:
        """Index of the position that a sensor reads of each velocity that none reads."""
        model, state_map = self.simulation.model, self.simulation.state_map
        read, known = (np.asarray(state_map.observe[rows].any(0)) for rows in (self.seen, slice(None)))
        pairs = {
            int(model.nq + model.jnt_dofadr[joint]): int(model.jnt_qposadr[joint])
            for joint in range(model.njnt)
            if model.jnt_type[joint] in _SINGLE
        }
        unread = {*state_map.hidden, *np.flatnonzero(known & ~read).tolist()}
        return {index: pairs[index] for index in sorted(unread) if index in pairs and read[pairs[index]]}

    @cached_property
    def settled(self) -> np.ndarray:
        """Whether a coordinate is one that a simulation along the data reaches, such as the depth of a contact, (m)."""
        hidden = [index not in self.positions_of_velocities for index in self.simulation.state_map.hidden]
        return np.array([False] * len(self.simulation.state_map.names) + hidden)

    @cached_property
    def read_states(self) -> tuple[np.ndarray, np.ndarray]:
        """As :attr:`states`, but without the coordinates that a simulation reaches."""
        before, after = (self.simulation.state_map.states(readings) for readings in self.readings)
        for run in self.measured.runs:
            for velocity, position in self.positions_of_velocities.items():
                path = np.append(before[run, position], after[run.stop - 1, position])
                rate = _derivative(path, self.simulation.control_step)
                before[run, velocity], after[run, velocity] = rate[:-1], rate[1:]
        return before, after

    @cached_property
    def states(self) -> tuple[np.ndarray, np.ndarray]:
        """States before and after each step, each (T, nq + nv).

        A velocity that no sensor reads is the derivative of its position, if one reads that. Other unobserved
        coordinates are those that a simulation along the data reaches.
        """
        simulation, measured, derived = self.simulation, self.measured, self.positions_of_velocities
        before, after = (states.copy() for states in self.read_states)
        if others := [index for index in simulation.state_map.hidden if index not in derived]:
            rows = np.arange(len(measured)) if self.rows is None else self.rows
            reached = settle(simulation, measured, before.copy(), self.executed, rows)
            before[:, others] = after[:, others] = reached[:, others]
            goes_on = measured.run[1:] == measured.run[:-1]
            after[:-1][np.ix_(goes_on, others)] = before[1:][np.ix_(goes_on, others)]
        return before, after

    @cached_property
    def spread(self) -> np.ndarray:
        """Standard deviation of each coordinate, (m), in its unit: of a reading in the log, else in rows for fits."""
        fitted = self.measured.split == Split.FIT
        if self.rows is not None:
            fitted &= np.isin(np.arange(len(fitted)), self.rows)
        spread = np.nanstd(self.states[0][fitted] @ self.from_state.T, axis=0)
        spread[: self.num_readings] = self.measured.observation[:, self.seen].std(0)
        return np.where(spread > STILL, spread, 1.0)


def true_readings(simulation: Simulation, measured: Measured) -> tuple[np.ndarray, np.ndarray]:
    """Readings before and after each step without the effects of a simulation's sensors, each (T, n)."""
    if not any(isinstance(effect, ObservationEffect) for effect in simulation.effects):
        return measured.observation, measured.following
    before, after = np.empty_like(measured.observation), np.empty_like(measured.following)
    for run in measured.runs:
        whole = np.vstack([measured.observation[run], measured.following[run][-1:]])
        true = simulation.true_observations(whole)
        before[run], after[run] = true[:-1], true[1:]
    return before, after


def _derivative(path: np.ndarray, step: float) -> np.ndarray:
    if len(path) < DERIVATIVE_ROWS:
        return np.gradient(path, step)
    return np.asarray(savgol_filter(path, DERIVATIVE_ROWS, 2, deriv=1, delta=step))
