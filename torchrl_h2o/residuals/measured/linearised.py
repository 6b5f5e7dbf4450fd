"""One control step linearised about every measured row, for the Kalman filter and the noise levels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

STATE_NUDGE = 1e-3  # step of the finite differences by the observation, in spreads


@dataclass(frozen=True, eq=False)
class Linearised:
    """One control step from every measured row, in units of each dimension's spread.

    Near row t, with observations o: ``o(t + 1) = reached[t] + slope[t] @ (o(t) - observed[t])``.

    Args:
        spread: (n), standard deviation of each dimension, in its unit; the other arrays are in these spreads.
        observed: (T, n), measured observations with sensor effects undone; NaN where they cannot be undone.
        reached: (T, n), simulated observations one control step later.
        slope: (T, n, n), their derivatives by the observations.
        follows: (T), True where the next row belongs to the same run.
        states: (T, nq + nv), start states of the simulation.
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
        at = {"time": measured.time, "activations": activations(simulation, measured, actions)}
        reached, slope = one_step(simulation, states, actions, STATE_NUDGE * spread, **at)
        slope = slope * spread / spread[:, None]
        follows = np.append(measured.run[1:] == measured.run[:-1], False)
        return cls(spread, observed / spread, reached / spread, slope, follows, states)

    @property
    def known(self) -> np.ndarray:
        """Mask (T) of the rows with a finite observation, step and derivative."""
        return cast(
            "np.ndarray",
            np.isfinite(self.observed).all(1) & np.isfinite(self.reached).all(1) & np.isfinite(self.slope).all((1, 2)),
        )

    def states_at(self, estimate: np.ndarray, state_map) -> np.ndarray:
        """States, (T, nq + nv), for estimated observations (T, n) in spreads.

        Rows without a finite estimate keep their measured state.
        """
        correction = np.nan_to_num(estimate - self.observed) * self.spread
        return self.states + correction @ state_map.restore_observed.T


def one_step(
    simulation: Simulation,
    states: np.ndarray,
    actions: np.ndarray,
    nudge: np.ndarray,
    *,
    time: np.ndarray,
    activations: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulates one control step and differentiates it by the previous observation, with finite differences.

    Args:
        simulation: the simulator.
        states: (B, nq + nv), start states.
        actions: (B, nu), executed actions.
        nudge: (n), steps of the differences, in the units of the observations.
        time: (B), start times in s.
        activations: (B, na), the actuators' activations at the start.

    Returns:
        Observations (B, n) and their derivatives by the previous observations (B, n, n); NaN where the simulation
        diverges.
    """
    steps = nudge * simulation.state_map.restore_observed

    def reached(simulation: Simulation, begun: np.ndarray) -> np.ndarray:
        copies = len(begun)
        after = simulation.rollout(
            begun.reshape(copies * len(states), -1),
            np.tile(actions, (copies, 1))[:, None],
            time=np.tile(time, copies),
            activations=np.tile(activations, (copies, 1)),
        )[:, 0]
        return simulation.state_map.observations(after).reshape(copies, len(states), -1)

    near = reached(simulation.quick, np.stack([states, *(states + step for step in steps.T)]))
    base = near[0] if simulation.quick is simulation else reached(simulation, states[None])[0]
    return base, np.moveaxis(near[1:] - near[0], 0, -1) / nudge
