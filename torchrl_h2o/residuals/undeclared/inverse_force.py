"""The residual as a generalised force: which force on a degree of freedom would make the simulator step as measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals, start_states
from torchrl_h2o.residuals.simulation.simulation import Simulation

_TAILS = 4.0  # degrees of freedom of the residuals' t-distribution: contacts and outliers make its tails heavy
_ITERATIONS = 15
_SHRINKAGE = 0.01  # of the scatter towards its diagonal, so that its inverse exists without noise
_NUDGE = 0.1  # of the typical force, for finite differences


@dataclass(frozen=True, eq=False)
class ResidualForces:
    """The residual of each transition, read as a force on one degree of freedom at a time.

    Args:
        force: (W, nv), in N or N·m, constant over the control step: the force on this degree of freedom alone that
            comes closest to the measured step.
        weight: (W, nv), one over the force's variance; zero where the step does not tell of it: nothing that is
            observed moves with it, or a stop or dry friction holds it.
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
    """The force that makes the simulator reproduce the measured step, for each degree of freedom by itself.

    Solving for the forces on all degrees of freedom at once would be exact, but where one of them is hardly observed it
    turns noise into large forces on all. One at a time needs no such inversion, and what a regression of these forces
    with these weights explains is just what the force explains of the residual (generalised least squares).

    Args:
        simulation: the simulator.
        measured: the data.
        starts: (W), the transitions.
        residual: (W, n), to explain; the simulation's own by default.
        response: (W, n, nv), of what is observed to the forces; :func:`force_response` by default.

    Returns:
        The forces and what they weigh.
    """
    if residual is None:
        residual = residuals(simulation, measured, starts)[:, 0]
    if response is None:
        response = force_response(simulation, measured, starts)
    finite = np.isfinite(residual).all(1) & np.isfinite(response).all((1, 2))
    residual, response = np.where(finite[:, None], residual, 0.0), np.where(finite[:, None, None], response, 0.0)
    precision, rows = _precision(residual, finite)
    towards = np.einsum("wnv,nm->wmv", response, precision)
    weight = np.einsum("wmv,wmv->wv", towards, response)
    force = np.einsum("wmv,wm->wv", towards, residual) / np.where(weight > 0.0, weight, 1.0)
    return ResidualForces(force, weight * rows[:, None])


def force_response(
    simulation: Simulation, measured: Measured, starts: np.ndarray, *, states: np.ndarray | None = None
) -> np.ndarray:
    """How what is observed after a control step changes with the generalised forces, (W, n, nv), per N or N·m.

    By finite differences, with steps of the size of the forces that move the data: across dry friction and soft
    contacts the derivative at a point would say little.
    """
    model, state_map = simulation.model, simulation.state_map
    states = start_states(simulation, measured, starts) if states is None else states
    missed = residuals(simulation, measured, starts, states=states)[:, 0]
    states, actions = states[starts], executed_actions(simulation, measured)[starts][:, None]
    change = np.nanstd(missed @ state_map.restore.T, axis=0)[model.nq :]
    change = np.maximum(change, 1e-6 + 1e-4 * np.nanstd(states[:, model.nq :], axis=0))
    size = _NUDGE * model.dof_M0 * change / simulation.control_step
    columns = []
    for dof in range(model.nv):
        push = np.zeros((len(starts), 1, model.nv))
        push[..., dof] = size[dof]
        ends = [
            state_map.observations(simulation.rollout(states, actions, time=measured.time[starts], applied=sign * push))
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1])[:, 0] / (2.0 * size[dof]))
    return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class StepPath:
    """The states that a transition passes through, at the start of every physics step.

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
    """The path of each transition: as simulated, bent to where it was measured to end."""
    model, steps = simulation.model, simulation.frame_skip
    states = start_states(simulation, measured, starts) if states is None else states
    missed = residuals(simulation, measured, starts, states=states)[:, 0] @ simulation.state_map.restore.T
    states = states[starts]
    actions = np.repeat(executed_actions(simulation, measured)[starts][:, None], steps, axis=1)
    time = measured.time[starts]
    finely = replace(simulation, frame_skip=1).rollout(states, actions, time=time)
    path = np.concatenate([states[:, None], finely[:, :-1]], axis=1)
    path = path + np.linspace(0.0, 1.0, steps, endpoint=False)[:, None] * missed[:, None]
    moments = time[:, None] + model.opt.timestep * np.arange(steps)
    return StepPath(path[..., : model.nq], path[..., model.nq :], actions, moments)


def _precision(residual: np.ndarray, finite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of the residuals' scatter, (n, n), and each row's weight, (W), by a multivariate t-distribution."""
    size = residual.shape[1]
    rows = finite.astype(float)
    for _ in range(_ITERATIONS):
        scatter = (rows[:, None] * residual).T @ residual / max(finite.sum(), 1)
        floor = np.maximum(np.diag(scatter), 1e-12 * scatter.trace() + 1e-30)
        precision = np.linalg.inv((1.0 - _SHRINKAGE) * scatter + _SHRINKAGE * np.diag(floor))
        distance = np.einsum("wn,nm,wm->w", residual, precision, residual)
        rows = finite * (_TAILS + size) / (_TAILS + distance)
    return precision, rows
