"""Many states of MuJoCo models, stepped at once by ``mujoco.rollout``, also under forces that follow the state."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from torchrl_h2o.effects.effect import BatchedForce

FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
_CTRL_AND_FORCE = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED)


def roll_out(
    pool: Rollout,
    models: mujoco.MjModel | Sequence[mujoco.MjModel],
    data: Sequence[mujoco.MjData],
    states: np.ndarray,
    actions: np.ndarray,
    physics_steps: int,
    *,
    forces: Sequence[BatchedForce] = (),
    applied: np.ndarray | None = None,
) -> np.ndarray:
    """Steps many states at once, each under its own actions.

    Without forces that follow the state this is one rollout. With them it goes physics step by physics step, each under
    the forces of the state that it starts from.

    Args:
        pool: of threads.
        models: one for all states, or one a state, all of the same sizes.
        data: scratch space, one a thread.
        states: (B, size), full physics states to start from.
        actions: (B, H, nu), each executed for one control step.
        physics_steps: of a control step.
        forces: functions of the state.
        applied: (B, H, nv), generalised forces in N or N·m beside these.

    Returns:
        The states after each control step, (B, H, size).
    """
    if not forces:
        control, spec = actions, _CTRL
        if applied is not None:
            control, spec = np.concatenate([actions, applied], -1), _CTRL_AND_FORCE
        control = np.repeat(control, physics_steps, axis=1)
        reached, _ = pool.rollout(models, data, states, control, control_spec=spec)
        return reached[:, physics_steps - 1 :: physics_steps]
    model = models if isinstance(models, mujoco.MjModel) else models[0]
    reached = []
    for step in range(actions.shape[1]):
        ctrl = actions[:, step]
        for _ in range(physics_steps):
            total = np.zeros((len(states), model.nv)) if applied is None else applied[:, step].copy()
            for force in forces:
                total += force(*positions_and_velocities(model, states), ctrl, states[:, 0])
            control = np.concatenate([ctrl, total], -1)[:, None]
            after, _ = pool.rollout(models, data, states, control, control_spec=_CTRL_AND_FORCE)
            states = after[:, 0]
        reached.append(states)
    return np.stack(reached, axis=1)


def positions_and_velocities(model: mujoco.MjModel, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Views of the positions, (B, nq), and velocities, (B, nv), in full physics states, (B, size)."""
    velocities = 1 + model.nq  # behind the time and the positions
    return states[:, 1:velocities], states[:, velocities : velocities + model.nv]
