"""Inverse dynamics of the residual: the generalised force that makes the simulator reproduce the measured step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from torchrl_h2o.likelihood import TAIL
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals, start_states
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

SCATTER_ITERATIONS = 15  # iterations of the scatter estimate
SHRINKAGE = 0.01  # shrinkage of the scatter towards its diagonal, so that it can be inverted without noise
FORCE_NUDGE = 0.1  # step of the finite differences by the force, as a share of the typical force


@dataclass(frozen=True, eq=False)
class ResidualForces:
    """The residual of each transition as a force on one degree of freedom at a time.

    Args:
        force: (W, nv), in N or N·m, constant over the control step: the force on this degree of freedom alone that
            reproduces the measured step best.
        weight: (W, nv), inverse variance of the force; zero where the observation does not depend on it, or a stop or
            dry friction holds the joint.
    """

    force: np.ndarray
    weight: np.ndarray


def residual_forces(
    simulation: Simulation,
    measured: Measured,
    starts: np.ndarray,
    *,
    residual: np.ndarray | None = None,
    response: np.ndarray | None = None,
) -> ResidualForces:
    """Computes the force that makes the simulator reproduce the measured step, for each degree of freedom alone.

    Solving for the forces on all degrees of freedom at once would be exact, but if one of them is hardly observed,
    noise would cause large forces on all of them. Solving for one force at a time avoids this inversion. A regression
    of these forces with these weights is a generalised least-squares regression of the residual.

    Args:
        simulation: the simulator.
        measured: the data.
        starts: (W), the transitions.
        residual: (W, n), residual to convert; that of the simulation by default.
        response: (W, n, nv), derivative of the observation by the forces; :func:`force_response` by default.

    Returns:
        The forces and their weights.
    """
    if residual is None:
        residual = residuals(simulation, measured, starts)[:, 0]
    if response is None:
        response = force_response(simulation, measured, starts)
    finite = cast("np.ndarray", np.isfinite(residual).all(1) & np.isfinite(response).all((1, 2)))
    residual, response = np.where(finite[:, None], residual, 0.0), np.where(finite[:, None, None], response, 0.0)
    precision, rows = _precision(residual, finite)
    towards = np.einsum("wnv,nm->wmv", response, precision)
    weight = np.einsum("wmv,wmv->wv", towards, response)
    force = np.einsum("wmv,wm->wv", towards, residual) / np.where(weight > 0.0, weight, 1.0)
    return ResidualForces(force, weight * rows[:, None])


def force_response(
    simulation: Simulation,
    measured: Measured,
    starts: np.ndarray,
    *,
    states: np.ndarray | None = None,
) -> np.ndarray:
    """Derivative of the observation after a control step by the generalised forces, (W, n, nv), per N or N·m.

    Computed by finite differences with steps of a fixed share of the typical force (``FORCE_NUDGE``), because
    the derivative at a point would be misleading near dry friction and soft contacts.
    """
    model, state_map = simulation.model, simulation.state_map
    states = start_states(simulation, measured, starts) if states is None else states
    missed = residuals(simulation, measured, starts, states=states)[:, 0]
    executed = executed_actions(simulation, measured)
    active = activations(simulation, measured, executed, states, starts)
    states, actions = states[starts], executed[starts][:, None]
    at = {"time": measured.time[starts], "activations": active[starts]}
    change = np.nanstd(missed @ state_map.restore.T, axis=0)[model.nq :]
    change = np.maximum(change, 1e-6 + 1e-4 * np.nanstd(states[:, model.nq :], axis=0))
    size = FORCE_NUDGE * model.dof_M0 * change / simulation.control_step
    columns = []
    for dof in range(model.nv):
        push = np.zeros((len(starts), 1, model.nv))
        push[..., dof] = size[dof]
        ends = [
            state_map.observations(simulation.rollout(states, actions, **at, applied=sign * push))
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1])[:, 0] / (2.0 * size[dof]))
    return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class StepPath:
    """States and controls of each transition at the start of every physics step.

    Args:
        qpos: (W, S, nq).
        qvel: (W, S, nv).
        ctrl: (W, S, nu).
        time: (W, S), in s.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    time: np.ndarray


def step_path(
    simulation: Simulation, measured: Measured, starts: np.ndarray, *, states: np.ndarray | None = None
) -> StepPath:
    """Simulated path of each transition, corrected linearly in time so that it ends at the measured state."""
    model, steps = simulation.model, simulation.frame_skip
    states = start_states(simulation, measured, starts) if states is None else states
    missed = residuals(simulation, measured, starts, states=states)[:, 0] @ simulation.state_map.restore.T
    executed = executed_actions(simulation, measured)
    active = activations(simulation, measured, executed, states, starts)
    at = {"time": measured.time[starts], "activations": active[starts]}
    states = states[starts]
    actions = np.repeat(executed[starts][:, None], steps, axis=1)
    finely = replace(simulation, frame_skip=1).rollout(states, actions, **at)
    path = np.concatenate([states[:, None], finely[:, :-1]], axis=1)
    path = path + np.linspace(0.0, 1.0, steps, endpoint=False)[:, None] * missed[:, None]
    moments = at["time"][:, None] + model.opt.timestep * np.arange(steps)
    return StepPath(path[..., : model.nq], path[..., model.nq :], actions, moments)


def _precision(residual: np.ndarray, finite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse scatter of the residuals, (n, n), and weight of each row, (W), under a multivariate t-distribution."""
    size = residual.shape[1]
    rows = finite.astype(float)
    for _ in range(SCATTER_ITERATIONS):
        scatter = (rows[:, None] * residual).T @ residual / max(finite.sum(), 1)
        floor = np.maximum(np.diag(scatter), 1e-12 * scatter.trace() + 1e-30)
        precision = np.linalg.inv((1.0 - SHRINKAGE) * scatter + SHRINKAGE * np.diag(floor))
        distance = np.einsum("wn,nm,wm->w", residual, precision, residual)
        rows = finite * (TAIL + size) / (TAIL + distance)
    return precision, rows
