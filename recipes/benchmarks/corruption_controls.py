"""Good logs of the benchmark: recorded with drawn dynamics gaps and noise, and real ones against their simulators."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from corruption_logs import NOISE, PENDULUM, ROWS, pendulum_simulation, read_pendulum
from systems import SYSTEMS
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_h2o.data import Column, LogColumns, load
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    ActionLag,
    Armature,
    BodyMass,
    Effect,
    Gravity,
    JointDamping,
    JointFrictionLoss,
    paper_gap,
)
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv
from torchrl_h2o.residuals import Simulation

GAPS = ("gravity", "friction", "joint_noise")
MODELS = Path(__file__).parents[1] / "models"


@dataclass(frozen=True, eq=False)
class Control:
    """A good log.

    Args:
        system: its name.
        words: what differs between log and simulator.
        load: returns the transitions and the simulation.
    """

    system: str
    words: str
    load: Callable[[], tuple[TensorDictBase, Simulation]]


def drawn_controls(draws: int) -> Iterator[Control]:
    """Recordings with 1 % noise, in turn without a gap, with one in reality, and with one of the paper's in the
    simulator.
    """
    names = ("HalfCheetah", "wheel_legged", "pendulum", "Walker2d")
    for number in range(draws):
        rng = np.random.default_rng([7, number])
        name = names[number % len(names)]
        kind = ("none", "reality", "simulator")[number % 3]
        reality: tuple[Effect, ...] = ()
        simulator: tuple[Effect, ...] = ()
        if kind == "reality":
            reality = (_effect(name, rng),)
        elif kind == "simulator":
            simulator = (paper_gap(GAPS[rng.integers(3)]) if name in ("HalfCheetah", "Walker2d") else Gravity(1.5),)
        differs = ", ".join(effect.describe() for effect in (*reality, *simulator)) or "nothing"
        yield Control(name, f"1 % noise, {kind}: {differs}", _recorded(name, reality, simulator, number))


def _effect(name: str, rng: np.random.Generator) -> Effect:

    torque = {"HalfCheetah": 10.0, "Walker2d": 5.0, "wheel_legged": 0.2, "pendulum": 0.2}[name]
    delay = {"HalfCheetah": 0.02, "Walker2d": 0.008, "wheel_legged": 0.012, "pendulum": 0.015}[name]
    candidates: Sequence[Effect] = (
        JointFrictionLoss(torque * rng.uniform(0.5, 1.5)),
        JointDamping(0.3 * torque * rng.uniform(0.5, 1.5)),
        ActionGain(0.7),
        ActionDelay(delay),
        ActionLag(delay),
        BodyMass(1.5),
        Armature({"HalfCheetah": 0.1, "Walker2d": 0.1, "wheel_legged": 0.005, "pendulum": 0.05}[name]),
    )
    return candidates[rng.integers(len(candidates))]


def _recorded(name: str, reality, simulator, seed: int) -> Callable[[], tuple[TensorDict, Simulation]]:
    def record() -> tuple[TensorDict, Simulation]:
        system = SYSTEMS[name]
        return system.record(reality, ROWS, seed, noise=NOISE), Simulation.from_env(system.env(simulator))

    return record


def real_controls(logs: Path) -> Iterator[Control]:
    """The real logs, and those of the unmodified tasks against simulators with the paper's gaps."""
    yield Control("wheel_legged", "the real robot", lambda: _wheel_legged(logs))
    for file in ("excitation_pd", "swing_up_energy", "swing_up_sac"):
        yield Control("simple_pendulum", file, lambda file=file: _simple_pendulum(logs, file))
    for number in ("00", "01", "02", "12"):
        yield Control("double_pendulum", f"trajectory_{number}", lambda number=number: _double_pendulum(logs, number))
    for name, task in (("halfcheetah", "HalfCheetah-v5"), ("walker2d", "Walker2d-v5")):
        for gap in (None, *GAPS):
            words = f"medium-replay, simulator: {gap or 'unmodified'}"
            yield Control(task, words, lambda name=name, task=task, gap=gap: _minari(logs, name, task, gap))


def _wheel_legged(logs: Path) -> tuple[TensorDict, Simulation]:
    data = load(logs / "wheel_legged" / "standing_still.txt", columns="wheel_legged_standing_still")
    return data, Simulation.from_env(WheelLeggedEnv())


def _simple_pendulum(logs: Path, file: str) -> tuple[TensorDict, Simulation]:
    step = 1 / 300 if file == "excitation_pd" else 0.005
    data = load(logs / "simple_pendulum" / f"{file}.csv", columns="simple_pendulum")
    return data, Simulation.from_mjcf(MODELS / "simple_pendulum.xml", ["hinge", "hinge_velocity"], step)


def _double_pendulum(logs: Path, number: str) -> tuple[TensorDict, Simulation]:
    """The whole file, with the first step of 3.3 ms."""
    names = ("pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2")
    columns = (
        Column("time", "time", "s"),
        *(Column(name, "observation") for name in names),
        *(Column(f"tau_meas{i}", "action", "N·m") for i in (1, 2)),
    )
    layout = LogColumns(
        columns, separator=",", header=True, other_columns="ignore", on_time_jump="split", time_tolerance=2.0
    )
    folder = logs / "double_pendulum"
    return load(folder / f"trajectory_{number}.csv", columns=layout), pendulum_simulation(folder)


def _minari(logs: Path, name: str, task: str, gap: str | None) -> tuple[TensorDict, Simulation]:
    effects = () if gap is None else (paper_gap(gap),)
    data = load(logs / "minari" / name / "medium-replay-v0")
    middle = len(data) // 2
    return data[middle : middle + ROWS], Simulation.from_env(TransformedEnv(GymEnv(task), DynamicsGap(*effects)))


__all__ = ["PENDULUM", "Control", "drawn_controls", "read_pendulum", "real_controls"]
