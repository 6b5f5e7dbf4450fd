"""The good logs that the benchmark damages, as tables of rows, and their way through a CSV file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from systems import SYSTEMS, with_sensor_noise
from tensordict import TensorDict, TensorDictBase

from torchrl_h2o.data import Column, LogColumns, read_robot_log
from torchrl_h2o.effects import JointFrictionLoss
from torchrl_h2o.residuals import Simulation

ROWS = 5000
NOISE = 0.01
PENDULUM_STEP = 0.002  # s
PENDULUM = ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
OTHER_LENGTH, OTHER_MASS = 2.0, 3.0  # factors of the other double pendulum


@dataclass(frozen=True, eq=False)
class DamagedLog:
    """Rows of a log.

    Args:
        observation: (T, n).
        action: (T, nu).
        time: stamps in s, (T,); None for a log without stamps.
        dt: the time step that is declared, in s; None for that of the stamps.
        edit: changes the text of the file.
    """

    observation: np.ndarray
    action: np.ndarray
    time: np.ndarray | None = None
    dt: float | None = None
    edit: Callable[[str], str] | None = None

    def take(self, rows: np.ndarray) -> DamagedLog:
        """The log with other rows, stamps included."""
        time = None if self.time is None else self.time[rows]
        return replace(self, observation=self.observation[rows], action=self.action[rows], time=time)

    def read(self, folder: Path) -> TensorDict:
        """Writes the rows to a CSV file and reads it.

        Raises:
            DataError: if the reader refuses the file.
        """
        columns = [self.observation, self.action]
        names = [f"o{i}" for i in range(self.observation.shape[1])] + [f"a{i}" for i in range(self.action.shape[1])]
        described = [Column(name, "observation" if name[0] == "o" else "action") for name in names]
        if self.time is not None:
            columns, names = [self.time[:, None], *columns], ["t", *names]
            described = [Column("t", "time", "s"), *described]
        lines = [",".join(names), *(",".join(f"{value:.9g}" for value in row) for row in np.hstack(columns))]
        text = "\n".join(lines) + "\n"
        path = folder / "log.csv"
        path.write_text(text if self.edit is None else self.edit(text))
        layout = LogColumns(tuple(described), dt=self.dt, separator=",", header=True, on_time_jump="split")
        return read_robot_log(path, layout)


@dataclass(frozen=True, eq=False)
class GoodLog:
    """A log without faults, and what damages need.

    Args:
        name: of the system.
        log: the rows.
        pairs: columns of position and velocity of each hinge joint.
        other_actions: actions of another run, (T, nu).
        other_robot: the log of another robot.
        build: builds the simulation from the control step.
        step: the control step, in s.
    """

    name: str
    log: DamagedLog
    pairs: tuple[tuple[int, int], ...]
    other_actions: np.ndarray
    other_robot: DamagedLog
    build: Callable[[float], Simulation]
    step: float

    def simulation(self, damaged: DamagedLog, transitions: TensorDictBase) -> Simulation:
        """The simulation with the control step that the log declares, as ``close-the-loop`` builds it."""
        step = damaged.dt
        if step is None and "time" in transitions.keys():
            step = float(torch.diff(transitions["time"].flatten()).median())
        return self.build(self.step if step is None else step)


def good_log(name: str, logs: Path | None) -> GoodLog | None:
    """A good log by the name of its system; None for the real double pendulum without its folder."""
    if name == "double_pendulum":
        return None if logs is None else _double_pendulum(logs / "double_pendulum")
    return _recorded(name)


def pendulum_simulation(folder: Path, step: float = PENDULUM_STEP, effects=()) -> Simulation:
    """The double pendulum; a step that is no multiple of the model's own is rounded, as jitter of a clock."""
    multiple = max(1, round(step / PENDULUM_STEP))
    near = abs(step - multiple * PENDULUM_STEP) < 0.01 * step
    step = multiple * PENDULUM_STEP if near else step
    return Simulation.from_mjcf(folder / "double_pendulum.xml", PENDULUM, step, effects)


def read_pendulum(folder: Path, number: str) -> DamagedLog:
    """A real run, without its first rows, whose steps take 3 ms."""
    table = np.genfromtxt(folder / f"trajectory_{number}.csv", delimiter=",", skip_header=1)[8:]
    return DamagedLog(table[:, 1:5], table[:, 7:9], table[:, 0])


def _double_pendulum(folder: Path) -> GoodLog:
    log = read_pendulum(folder, "01")
    return GoodLog(
        "double_pendulum",
        log,
        ((0, 2), (1, 3)),
        read_pendulum(folder, "02").action,
        _other_pendulum(folder, log),
        lambda step: pendulum_simulation(folder, step),
        PENDULUM_STEP,
    )


def _other_pendulum(folder: Path, log: DamagedLog) -> DamagedLog:
    """The motion of a longer and heavier double pendulum under torques that move it as far."""

    def spec() -> mujoco.MjSpec:
        other = mujoco.MjSpec.from_file(str(folder / "double_pendulum.xml"))
        for body in other.bodies[1:]:
            body.pos, body.ipos = OTHER_LENGTH * np.array(body.pos), OTHER_LENGTH * np.array(body.ipos)
            body.mass = OTHER_MASS * body.mass
            body.inertia = OTHER_MASS * OTHER_LENGTH**2 * np.array(body.inertia)
        return other

    plain = pendulum_simulation(folder)
    other = Simulation(spec, plain.frame_skip, plain.state_map, (JointFrictionLoss(0.5),), "other")
    action = OTHER_MASS * OTHER_LENGTH * log.action
    states = other.rollout(np.zeros((1, 4)), action[None])[0]
    observation = np.vstack([np.zeros(4), states[:-1]])
    noise = NOISE * observation.std(0) * np.random.default_rng(0).standard_normal(observation.shape)
    return replace(log, observation=observation + noise, action=action)


def _recorded(name: str) -> GoodLog:
    system = SYSTEMS[name]
    simulation = Simulation.from_env(system.env())
    columns = {coordinate: i for i, coordinate in enumerate(simulation.state_map.names)}
    pairs = tuple(
        (column, columns[f"{coordinate}_velocity"])
        for coordinate, column in columns.items()
        if simulation.state_map.units[column] == "rad" and f"{coordinate}_velocity" in columns
    )
    other = {"HalfCheetah": "Walker2d"}.get(name)
    if other is None:
        raise ValueError(f"no other robot has the observations of {name}; choose HalfCheetah")
    step = simulation.control_step
    return GoodLog(
        name,
        rows_of(system.record((), ROWS, 0, noise=NOISE, episode=ROWS), step),
        pairs,
        system.record((), ROWS, 1, episode=ROWS)["action"].double().numpy(),
        rows_of(SYSTEMS[other].record((), ROWS, 0, noise=NOISE, episode=ROWS), step),
        lambda step: simulation,
        step,
    )


def rows_of(transitions: TensorDict, dt: float) -> DamagedLog:
    """The rows of one recorded run."""
    return DamagedLog(transitions["observation"].double().numpy(), transitions["action"].double().numpy(), dt=dt)


__all__ = ["DamagedLog", "GoodLog", "good_log", "pendulum_simulation", "read_pendulum", "rows_of", "with_sensor_noise"]
