"""One step of a simulation about every measured row, as a linear map: what filters and noise levels are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.simulation.simulation import Simulation

_NUDGE = 1e-3  # of a dimension's spread, for the finite differences


@dataclass(frozen=True, eq=False)
class Linearised:
    """One control step from every measured row, in the spread of each observed dimension.

    Near row t, with o for observations: ``o(t + 1) = reached[t] + slope[t] @ (o(t) - observed[t])``.

    Args:
        spread: (n), of each dimension, in its unit; all else is in these spreads.
        observed: (T, n), what was measured, sensor effects undone; NaN where that cannot be told.
        reached: (T, n), what the simulation makes of it one control step later.
        slope: (T, n, n).
        follows: (T), whether the next row goes on with the same run.
        states: (T, nq + nv), the states that the simulation started from.
    """

    spread: np.ndarray
    observed: np.ndarray
    reached: np.ndarray
    slope: np.ndarray
    follows: np.ndarray
    states: np.ndarray

    @classmethod
    def about(cls, simulation: Simulation, measured: Measured) -> Linearised:
        """Linearises the simulation about every measured row, in one batch."""
        states = start_states(simulation, measured)
        observed = simulation.state_map.observations(states)
        spread = np.nanstd(observed, axis=0)
        spread = np.where(spread > 0.0, spread, 1.0)
        actions = executed_actions(simulation, measured)
        reached, slope = one_step(simulation, states, actions, measured.time, _NUDGE * spread)
        slope = slope * spread / spread[:, None]
        follows = np.append(measured.run[1:] == measured.run[:-1], False)
        return cls(spread, observed / spread, reached / spread, slope, follows, states)

    @property
    def known(self) -> np.ndarray:
        """Rows, (T), that were observed and that the simulation goes on from."""
        return (
            np.isfinite(self.observed).all(1) & np.isfinite(self.reached).all(1) & np.isfinite(self.slope).all((1, 2))
        )

    def states_at(self, estimate: np.ndarray, state_map) -> np.ndarray:
        """The states, (T, nq + nv), that estimated observations (T, n), in spreads, tell of.

        Where nothing is known the measured state stands.
        """
        correction = np.nan_to_num(estimate - self.observed) * self.spread
        return self.states + correction @ state_map.restore.T


def one_step(
    simulation: Simulation, states: np.ndarray, actions: np.ndarray, time: np.ndarray, nudge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What is observed after one control step, and how that changes with what was observed before, by differences.

    Args:
        simulation: the simulator.
        states: (B, nq + nv), to start from.
        actions: (B, nu), as executed.
        time: (B), of the start, in s.
        nudge: (n), the steps of the differences, in the units of the observations.

    Returns:
        Observations (B, n), and their derivatives by those before (B, n, n); NaN where the simulation diverges.
    """
    steps = nudge * simulation.state_map.restore
    begun = np.concatenate([states, *(states + step for step in steps.T)])
    copies = 1 + len(nudge)
    reached = simulation.rollout(begun, np.tile(actions, (copies, 1))[:, None], time=np.tile(time, copies))[:, 0]
    reached = simulation.state_map.observations(reached).reshape(copies, len(states), -1)
    return reached[0], np.moveaxis(reached[1:] - reached[0], 0, -1) / nudge
