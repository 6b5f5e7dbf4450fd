"""Steps many states of MuJoCo models at once with ``mujoco.rollout``, optionally under state-dependent forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from torchrl_h2o.effects.states import BatchedForce, States, Variation

FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = int(mujoco.mjtState.mjSTATE_CTRL)
ALONE = Rollout(nthread=0)  # steps in the calling thread
_FEW = 128  # physics steps of one rollout below which threads cost more time than they save
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
    variations: Sequence[Variation] = (),
    applied: np.ndarray | None = None,
) -> np.ndarray:
    """Steps many states at once, each under its own actions.

    Without forces and variations that depend on the state this is one rollout. With these it takes one physics step at
    a time; each step uses those at the state before it.

    Args:
        pool: the threads of ``mujoco.rollout``.
        models: one model for all states, or one per state, all of the same sizes. With variations, each state needs
            a copy of its own, into which its numbers are written during the call.
        data: scratch space, one per thread.
        states: initial full physics states, (B, size).
        actions: actions, (B, H, nu), each executed for one control step.
        physics_steps: physics steps per control step.
        forces: generalised forces as functions of the state.
        variations: how numbers of the models depend on the state.
        applied: further generalised forces in N or N·m, (B, H, nv), constant within a control step.

    Returns:
        The states after each control step, (B, H, size).
    """
    in_single_steps = bool(forces or variations)
    if len(states) * (1 if in_single_steps else actions.shape[1] * physics_steps) <= _FEW:
        pool, data = ALONE, data[:1]
    one_each = list(models) if isinstance(models, Sequence) else [models] * len(states)

    def reached_by(states: np.ndarray, control: np.ndarray, spec: int) -> np.ndarray:
        """States after each physics step, without checks of shapes, which take longer than a few steps."""
        reached = np.empty((*control.shape[:2], states.shape[1]))
        pool.rollout(
            one_each,
            list(data),
            np.ascontiguousarray(states, np.float64),
            np.ascontiguousarray(control, np.float64),
            control_spec=spec,
            skip_checks=True,
            nstep=control.shape[1],
            state=reached,
        )
        return reached

    if not in_single_steps:
        control, spec = actions, _CTRL
        if applied is not None:
            control, spec = np.concatenate([actions, applied], -1), _CTRL_AND_FORCE
        control = np.repeat(control, physics_steps, axis=1)
        return reached_by(states, control, spec)[:, physics_steps - 1 :: physics_steps]
    model, after_each = one_each[0], []
    fields = dict.fromkeys(field for variation in variations for field in variation.fields)
    places = {field: [getattr(one, field) for one in one_each] for field in fields}
    own = {field: np.stack(values) for field, values in places.items()}
    for step in range(actions.shape[1]):
        ctrl = actions[:, step]
        for _ in range(physics_steps):
            now = states_of(model, states, ctrl)
            total = np.zeros((len(states), model.nv)) if applied is None else applied[:, step].copy()
            for force in forces:
                total += force(now)
            values = {field: value.copy() for field, value in own.items()}
            for variation in variations:
                total += variation.apply(now, values)
            _write(values, places)
            control = np.concatenate([ctrl, total], -1)[:, None]
            states = reached_by(states, control, _CTRL_AND_FORCE)[:, 0]
        after_each.append(states)
    _write(own, places)
    return np.stack(after_each, axis=1)


def _write(values: Mapping[str, np.ndarray], places: Mapping[str, Sequence[np.ndarray]]) -> None:
    """Writes the values (B, ...) of fields into the models."""
    for field, of_models in places.items():
        for place, value in zip(of_models, values[field], strict=True):
            place[:] = value


def states_of(model: mujoco.MjModel, full: np.ndarray, ctrl: np.ndarray) -> States:
    """Returns views of the parts of full physics states (B, size) under controls (B, nu)."""
    positions, velocities = positions_and_velocities(model, full)
    after = 1 + model.nq + model.nv
    return States(positions, velocities, full[:, after : after + model.na], ctrl, full[:, 0])


def positions_and_velocities(model: mujoco.MjModel, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns views of the positions (B, nq) and velocities (B, nv) in full physics states (B, size)."""
    velocities = 1 + model.nq  # the state starts with the time and the positions
    return states[:, 1:velocities], states[:, velocities : velocities + model.nv]
