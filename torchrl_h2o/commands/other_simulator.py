"""Records a second simulator in the place of a robot, to find what the first one lacks compared with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_h2o.data import Column, LogColumns
from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.effects.model.servo import is_servo, is_velocity_servo
from torchrl_h2o.residuals.simulation.model_file import read_model, read_spec
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.simulation.state_map import coordinate_names

MODELS = (".xml", ".urdf")
SECONDS = 20.0  # of the recording
STEP = 0.01  # s, control step, if none is given and the model's timestep is shorter
FREQUENCIES = np.geomspace(0.1, 2.5, 8)  # Hz, of the sines in each command
TURN = 0.5  # amplitude of a servo's targets, in rad, rad/s, m, m/s or half-ranges of its commands if those are less
ACCELERATION = 15.0  # rad/s² or m/s² to which the largest command of a motor without a range leads, beyond its weight


def is_model(source: object) -> bool:
    """Whether a source of data is a model file."""
    return isinstance(source, str) and source.lower().endswith(MODELS)


def record_simulator(
    path: str | Path, like: str | Path, control_step: float | None, seed: int
) -> tuple[TensorDict, LogColumns]:
    """Records 20 s of a model that begins in its initial pose, under sums of sines on all actuators.

    Args:
        path: an MJCF or URDF file.
        like: the model that is compared with it; the actions are in the order of its actuators.
        control_step: the time between two rows, in s.
        seed: seed of the sines' phases.

    Returns:
        The transitions, batch size (T,), of all coordinates, and the description of their columns.

    Raises:
        ValueError: for a file that is not a model, actuators that do not match, or a simulation that diverges.
    """
    path, like = Path(path), Path(like)
    model = read_model(path)
    actuators = actuators_of(path)
    order = matched(actuators, actuators_of(like), path, like)
    step = control_step or max(STEP, model.opt.timestep)
    names, units = coordinate_names(model)
    simulation = Simulation.from_mjcf(path, names, step)
    actions = commands(model, [one.kind for one in actuators], round(SECONDS / step), step, np.random.default_rng(seed))
    start = np.concatenate([model.qpos0, np.zeros(model.nv)])[None]
    states = np.concatenate([start, simulation.rollout(start, actions[None])[0]])
    if not np.isfinite(states).all():
        raise ValueError(f"the simulation of {path} diverges under commands of its actuators; check its timestep")
    observed = simulation.observed(states)
    last = np.arange(len(actions)) == len(actions) - 1
    transitions = to_ted(
        observation=observed[:-1],
        action=actions[:, order],
        next_observation=observed[1:],
        terminated=np.zeros(len(actions), bool),
        truncated=last,
    )
    transitions["time"] = step * torch.arange(len(actions), dtype=torch.float64)[:, None]
    torchrl_logger.info(f"{path}: {SECONDS:g} s under sines of {FREQUENCIES[0]:g} to {FREQUENCIES[-1]:g} Hz")
    columns = [Column(name, "observation", unit) for name, unit in zip(names, units, strict=True)]
    columns += [Column(f"command of {actuators[i].name}", "action") for i in order]
    return transitions, LogColumns(tuple(columns), dt=step, free_motion=not model.nu)


class Actuator(NamedTuple):
    """An actuator: its name, the joint that it moves, and what it is."""

    name: str
    joint: str
    kind: Literal["position servo", "velocity servo", "motor"]


def actuators_of(path: Path) -> list[Actuator]:
    """The actuators of a model; one without a name is called like its joint, one without a joint by its number."""
    model, found = read_model(path), []
    for index, one in enumerate(read_spec(path).actuators):
        on_joint = model.actuator_trntype[index] == mujoco.mjtTrn.mjTRN_JOINT
        joint = model.joint(model.actuator_trnid[index, 0]).name if on_joint else f"actuator {index}"
        kind = "position servo" if is_servo(one) else "velocity servo" if is_velocity_servo(one) else "motor"
        found.append(Actuator(one.name or joint, joint, kind))
    return found


def matched(own: Sequence[Actuator], other: Sequence[Actuator], path: Path, like: Path) -> list[int]:
    """Indices of a model's actuators in the order of another one's: by their names, or else by their joints.

    Raises:
        ValueError: if there are others, or a servo in the place of a motor.
    """
    for label in ("name", "joint"):
        labels, wanted = ([getattr(one, label) for one in actuators] for actuators in (own, other))
        if sorted(labels) == sorted(wanted) and len(set(labels)) == len(labels):
            break
    else:
        raise ValueError(
            f"the actuators of {path}, {', '.join(labels) or 'none'}, are not those of {like}, "
            f"{', '.join(wanted) or 'none'}; give them the same names"
        )
    order = [labels.index(name) for name in wanted]
    for index, wanted_one in zip(order, other, strict=True):
        if own[index].kind != wanted_one.kind:
            kinds = f"a {own[index].kind} in {path} and a {wanted_one.kind} in {like}"
            raise ValueError(f"{own[index].name} is {kinds}; make them alike")
    return order


def commands(
    model: mujoco.MjModel, kinds: Sequence[str], rows: int, step: float, rng: np.random.Generator
) -> np.ndarray:
    """Commands of all actuators: sums of sines with random phases, (rows, nu).

    Args:
        model: the model.
        kinds: for each actuator, "position servo", "velocity servo" or "motor".
        rows: number of control steps.
        step: the control step in s.
        rng: random numbers for the phases.
    """
    time = step * np.arange(rows)
    phases = rng.uniform(0.0, 2.0 * np.pi, (model.nu, len(FREQUENCIES)))
    waves = np.sin(2.0 * np.pi * FREQUENCIES * time[:, None, None] + phases).sum(-1)
    waves /= np.maximum(np.abs(waves).max(0), 1e-12)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    low, high = model.actuator_ctrlrange.T
    limited = model.actuator_ctrllimited.astype(bool)
    half = np.where(limited, 0.5 * (high - low), np.inf)
    moved = np.zeros((model.nu, model.nv))
    sparse = (data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    mujoco.mju_sparse2dense(moved, data.actuator_moment, *sparse)
    load = np.abs(moved) @ (ACCELERATION * model.dof_M0 + np.abs(data.qfrc_bias))
    gain = np.abs(model.actuator_gainprm[:, 0]) * (moved**2).sum(1)
    is_motor = np.array([kind == "motor" for kind in kinds], bool)
    sizes = np.where(is_motor, np.minimum(load / np.maximum(gain, 1e-12), half), np.minimum(TURN, TURN * half))
    at_rest = np.where([kind == "position servo" for kind in kinds], data.actuator_length, 0.0)
    middle = np.where(is_motor & limited, 0.5 * (low + high), at_rest)
    return middle + sizes * waves
