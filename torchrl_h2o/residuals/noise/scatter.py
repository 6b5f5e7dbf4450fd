"""One-step residuals with their derivatives by action and sensors: the data of the noise estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.stats import norm

from torchrl_h2o.residuals.measured.linearised import one_step
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals, start_states
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

NUDGE = 1e-4  # step of the finite differences, in spreads or in shares of the largest action


@dataclass(frozen=True, eq=False)
class Scatter:
    """One-step residuals of the W transitions without contacts nearby, in units of each dimension's scale.

    Args:
        residual: (W, n).
        by_action: (W, n, nu), derivative of the observation by the executed action.
        by_sensor: (W, n, n), derivative of the observation by the previous observation.
        executed: (W, nu), executed actions, in their units.
        limits: (nu, 2), control range; infinite for an actuator without limits.
        scale: (n), scale of the residual, in units of the observations.
    """

    residual: np.ndarray
    by_action: np.ndarray
    by_sensor: np.ndarray
    executed: np.ndarray
    limits: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(
        cls,
        simulation: Simulation,
        measured: Measured,
        rows: np.ndarray,
        scale: np.ndarray | None = None,
    ) -> Scatter:
        """Residuals of some transitions; their scale is the mean absolute residual by default."""
        states = start_states(simulation, measured, rows)
        residual = residuals(simulation, measured, rows, states=states)[:, 0]
        by_action, by_sensor = derivatives(simulation, measured, rows, states, NUDGE)
        whole = np.isfinite(residual).all(1) & np.isfinite(by_action).all((1, 2)) & np.isfinite(by_sensor).all((1, 2))
        # keeps the half of the transitions in which noise grows least, because derivatives are invalid near contacts
        growth = np.where(whole, (by_sensor**2).sum((1, 2)), np.inf)
        calm = whole & (growth <= np.median(growth[whole]))
        residual, by_action, by_sensor = residual[calm], by_action[calm], by_sensor[calm]
        if scale is None:
            smallest = 1e-9 * measured.observation.std(0) + 1e-12
            scale = cast("np.ndarray", np.maximum(np.abs(residual).mean(0), smallest))
        model = simulation.model
        free = ~model.actuator_ctrllimited.astype(bool)
        limits = np.where(free[:, None], [-np.inf, np.inf], model.actuator_ctrlrange)
        executed = np.clip(executed_actions(simulation, measured)[rows][calm], *limits.T)
        by_action, by_sensor = by_action / scale[:, None], by_sensor * scale / scale[:, None]
        return cls(residual / scale, by_action, by_sensor, executed, limits, scale)

    def without_action(self) -> Scatter:
        """The residuals without the derivative by the action."""
        return replace(self, by_action=self.by_action[:, :, :0], executed=self.executed[:, :0], limits=self.limits[:0])

    def clamped(self, std: float) -> np.ndarray:
        """Derivative by the action, (W, n, nu), reduced to the share of noise that the control limits leave."""
        if std == 0.0 or not np.isfinite(self.limits).any():
            return self.by_action
        # second moment of a normal variable clamped to two limits; limits beyond 40 deviations have no effect
        low, high = (np.clip((limit - self.executed) / std, -40.0, 40.0) for limit in self.limits.T)
        inside = norm.cdf(high) - norm.cdf(low) - high * norm.pdf(high) + low * norm.pdf(low)
        left = inside + low**2 * norm.cdf(low) + high**2 * norm.sf(high)
        return self.by_action * np.sqrt(np.maximum(left, 0.0))[:, None]


def derivatives(
    simulation: Simulation,
    measured: Measured,
    rows: np.ndarray,
    states: np.ndarray,
    nudge: float = NUDGE,
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiates the observation after one step by finite differences.

    Args:
        simulation: the simulator.
        measured: the data.
        rows: (W), the transitions.
        states: (T, nq + nv), start states.
        nudge: step, in spreads of the observation and shares of the largest action.

    Returns:
        Derivatives by the executed action, (W, n, nu), and by the previous observation, (W, n, n), in their units.
    """
    start, executed = states[rows], executed_actions(simulation, measured)
    actions = executed[rows]
    at = {"time": measured.time[rows], "activations": activations(simulation, measured, executed)[rows]}
    base, by_sensor = one_step(simulation, start, actions, nudge * (measured.observation.std(0) + 1e-9), **at)
    by_action = []
    for index in range(actions.shape[1]):
        # a step towards zero, because the control range may clamp a step outwards
        step = np.zeros_like(actions)
        size = nudge * (np.abs(actions[:, index]).max() + 1e-6)
        step[:, index] = np.where(actions[:, index] > 0.0, -size, size)
        reached = simulation.rollout(start, (actions + step)[:, None], **at)[:, 0]
        by_action.append((simulation.state_map.observations(reached) - base) / step[:, index, None])
    return np.stack(by_action, axis=-1), by_sensor
