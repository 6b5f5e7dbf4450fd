"""Records a second simulator in the place of a robot, to find what the first one lacks compared with it."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_h2o.data import Column, LogColumns
from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.effects.model.servo import is_servo
from torchrl_h2o.residuals.simulation.model_file import read_model, read_spec
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.simulation.state_map import coordinate_names

MODELS = (".xml", ".urdf")
SECONDS = 20.0  # of the recording
STEP = 0.01  # s, control step, if none is given and the model's timestep is shorter
FREQUENCIES = np.geomspace(0.1, 2.5, 8)  # Hz, of the sines in each command
TURN = (
    0.5  # amplitude of a servo's targets about its middle, in rad, m or half-ranges of its commands if those are less
)
ACCELERATION = 15.0  # rad/s² or m/s² to which the largest command of a motor without a range leads, beyond its weight


def is_model(source: object) -> bool:
    """Whether a source of data is a model file."""
    return isinstance(source, str) and source.lower().endswith(MODELS)


def record_simulator(path: str | Path, control_step: float | None, seed: int) -> tuple[TensorDict, LogColumns]:
    """Records 20 s of a model that begins in its initial pose, under sums of sines on all actuators.

    Args:
        path: an MJCF or URDF file.
        control_step: the time between two rows, in s.
        seed: seed of the sines' phases.

    Returns:
        The transitions, batch size (T,), of all coordinates, and the description of their columns.

    Raises:
        ValueError: for a file that is not a model, or a simulation that diverges.
    """
    path = Path(path)
    model, spec = read_model(path), read_spec(path)
    step = control_step or max(STEP, model.opt.timestep)
    names, units = coordinate_names(model)
    simulation = Simulation.from_mjcf(path, names, step)
    servos = [is_servo(actuator) for actuator in spec.actuators]
    actions = commands(model, servos, round(SECONDS / step), step, np.random.default_rng(seed))
    start = np.concatenate([model.qpos0, np.zeros(model.nv)])[None]
    states = np.concatenate([start, simulation.rollout(start, actions[None])[0]])
    if not np.isfinite(states).all():
        raise ValueError(f"the simulation of {path} diverges under commands of its actuators; check its timestep")
    observed = simulation.observed(states)
    last = np.arange(len(actions)) == len(actions) - 1
    transitions = to_ted(
        observation=observed[:-1],
        action=actions,
        next_observation=observed[1:],
        terminated=np.zeros(len(actions), bool),
        truncated=last,
    )
    transitions["time"] = step * torch.arange(len(actions), dtype=torch.float64)[:, None]
    torchrl_logger.info(
        f"{path}: recorded for {SECONDS:g} s under sines of {FREQUENCIES[0]:g} to {FREQUENCIES[-1]:g} Hz"
    )
    columns = [Column(name, "observation", unit) for name, unit in zip(names, units, strict=True)]
    columns += [Column(model.actuator(i).name or f"actuator {i}", "action") for i in range(model.nu)]
    return transitions, LogColumns(tuple(columns), dt=step, free_motion=not model.nu)


def commands(model: mujoco.MjModel, servos: list[bool], rows: int, step: float, rng: np.random.Generator) -> np.ndarray:
    """Commands of all actuators: sums of sines with random phases, (rows, nu).

    Args:
        model: the model.
        servos: whether each actuator is a position servo.
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
    half = np.where(model.actuator_ctrllimited.astype(bool), 0.5 * (high - low), np.inf)
    moved = np.zeros((model.nu, model.nv))
    sparse = (data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    mujoco.mju_sparse2dense(moved, data.actuator_moment, *sparse)
    load = np.abs(moved) @ (ACCELERATION * model.dof_M0 + np.abs(data.qfrc_bias))
    force = load / np.maximum((moved**2).sum(1), 1e-12)
    sizes = np.where(servos, np.minimum(TURN, TURN * half), np.minimum(force, half))
    middle = np.where(servos, data.actuator_length, np.where(np.isfinite(half), np.nan_to_num(0.5 * (low + high)), 0.0))
    return np.clip(middle + sizes * waves, middle - sizes, middle + sizes)
