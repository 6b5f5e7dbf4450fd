"""Simulated machines with several faults at once, logged as a laboratory logs: encoders, and velocities from a filter.

Their physics is written here with MuJoCo alone, not with the effects of the library.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import mujoco
import numpy as np

MODELS = Path(__file__).with_name("machines")
SUBSTEPS = 20  # physics steps of the machine per control step; its model has 4
FRICTION_WIDTH = 0.005  # rad/s or m/s, in which dry friction changes its sign

Torque = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Machine:
    """A machine, the commands that move it, and its sensors.

    Args:
        model: name of the MJCF file, which lacks the machine's faults.
        step: control step, in s.
        rows: rows of the log.
        command: standard deviation of the random commands, by actuator.
        memory: time constant of the random commands, in s.
        hold: gain of the feedback from positions, by actuator.
        brake: gain of the feedback from velocities, by actuator.
        encoder: resolution of the positions, in rad or m.
        filter_time: time constant of the filter on the positions' differences, in s.
        change: changes the specification of the model.
        torque: generalised forces from qpos and qvel; none by default.
        gain: factor on the commands, by actuator.
        delay: time by which commands act late, in s.
    """

    model: str
    step: float
    command: tuple[float, ...]
    rows: int = 6000
    memory: float = 0.15
    hold: tuple[float, ...] = ()
    brake: tuple[float, ...] = ()
    encoder: tuple[float, ...] = ()
    filter_time: float = 0.005
    change: Callable[[mujoco.MjSpec], None] = lambda spec: None
    torque: Torque | None = None
    gain: tuple[float, ...] = ()
    delay: float = 0.0

    @property
    def path(self) -> Path:
        """The MJCF file."""
        return MODELS / f"{self.model}.xml"

    def record(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """One run from rest: positions and velocities, (T, 2 nq), and commands, (T, nu)."""
        spec = mujoco.MjSpec.from_file(str(self.path))
        spec.option.timestep = self.step / SUBSTEPS
        self.change(spec)
        model = spec.compile()
        data, sensors = mujoco.MjData(model), _Sensors(self, model.nq)
        rng, std = np.random.default_rng(seed), np.array(self.command)
        hold, brake, gain = (np.array(given or (default,) * model.nu) for given, default in self._gains)
        memory, noise = np.exp(-self.step / self.memory), np.zeros(model.nu)
        waiting = [np.zeros(model.nu)] * round(self.delay * SUBSTEPS / self.step)
        observed, commands = [], []
        for _ in range(self.rows):
            position, velocity = sensors.read(data.qpos)
            noise = memory * noise + np.sqrt(1.0 - memory**2) * std * rng.standard_normal(model.nu)
            command = noise - hold * position[: model.nu] - brake * velocity[: model.nu]
            observed.append(np.concatenate([position, velocity]))
            commands.append(command)
            for _ in range(SUBSTEPS):
                waiting.append(command)
                data.ctrl[:] = gain * waiting.pop(0)
                data.qfrc_applied[:] = 0.0 if self.torque is None else self.torque(data.qpos, data.qvel)
                mujoco.mj_step(model, data)
        return np.array(observed), np.array(commands)

    @property
    def _gains(self) -> tuple[tuple[tuple[float, ...], float], ...]:
        return (self.hold, 0.0), (self.brake, 0.0), (self.gain, 1.0)


@dataclass
class _Sensors:
    """Encoders, and a first-order filter on the differences of their readings."""

    machine: Machine
    number: int
    before: np.ndarray | None = None
    filtered: np.ndarray = field(default_factory=lambda: np.zeros(()))

    def read(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity."""
        step, resolution = self.machine.step, np.array(self.machine.encoder or (2.0 * np.pi / 8192,) * self.number)
        position = np.round(qpos / resolution) * resolution
        difference = (position - (position if self.before is None else self.before)) / step
        share = 1.0 - np.exp(-step / self.machine.filter_time)
        self.before, self.filtered = position, self.filtered + share * (difference - self.filtered)
        return position, self.filtered


def dry(velocity: np.ndarray, width: float = FRICTION_WIDTH) -> np.ndarray:
    """Sign of a velocity, continuous at rest."""
    return np.tanh(velocity / width)


def _cart_pole(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.array([-1.5 * dry(v[0]) - 0.8 * v[0], 0.0])


def _heavier_pole(spec: mujoco.MjSpec) -> None:
    spec.geom("pole").mass *= 1.15


def _geared_arm(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    stribeck = 0.3 + 0.25 * np.exp(-((v / 0.15) ** 2))
    cogging = 0.15 * np.sin(8.0 * q + 0.7)
    return cogging - stribeck * dry(v)


def _payload(spec: mujoco.MjSpec) -> None:
    spec.body("lower").add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=[0, 0, -0.3], size=[0.02, 0, 0], mass=0.4, contype=0, conaffinity=0
    )


def _cable(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.array([0.0, 0.0, -0.8 * (q[2] - 0.3)])


def _shoulder_friction(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.array([-0.2 * dry(v[0]), 0.0])


def _weak_servos(spec: mujoco.MjSpec) -> None:
    for servo in spec.actuators:
        servo.gainprm[0] *= 0.7
        servo.biasprm[1] *= 0.7


def _small_losses(spec: mujoco.MjSpec) -> None:
    spec.joint("arm").armature, spec.joint("arm").damping = 4e-5, [5e-4, 0.0, 0.0]
    spec.joint("pendulum").damping = [5e-5, 0.0, 0.0]


def _arm_friction(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    dry_friction, viscous = np.array([6.0, 7.0, 5.0, 1.2, 1.0, 0.8]), np.array([4.0, 5.0, 3.0, 0.6, 0.5, 0.4])
    return -dry_friction * dry(v) - viscous * v


def _axis(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return -20.0 * dry(v, width=0.001) - 200.0 * v - 3.0  # a carriage is slow


def _tool(spec: mujoco.MjSpec) -> None:
    spec.body("wrist_3").add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=[0, 0.12, 0.03], size=[0.03, 0, 0], mass=1.2, contype=0, conaffinity=0
    )


LINKS = {"step": 0.005, "command": (4.0, 1.2), "hold": (3.0, 1.0)}
MACHINES: Mapping[str, Machine] = MappingProxyType(
    {
        "cart-pole": Machine(
            model="cart_pole",
            step=0.01,
            command=(5.0,),
            memory=0.3,
            hold=(8.0,),
            brake=(1.0,),
            encoder=(1e-4, 2.0 * np.pi / 4096),
            change=_heavier_pole,
            torque=_cart_pole,
        ),
        "two links with a payload": Machine(model="two_links", change=_payload, gain=(1.0, 0.9), **LINKS),
        "two links without a fault": Machine(model="two_links", **LINKS),
        "leg with a cable": Machine(
            model="cable_leg",
            step=0.004,
            command=(2.0, 2.0, 0.8),
            memory=0.12,
            hold=(3.0, 2.0, 1.0),
            brake=(0.1, 0.1, 0.1),
            torque=_cable,
            delay=0.008,
        ),
        "links with weak servos": Machine(
            model="servo_links", step=0.005, command=(0.5, 0.5), change=_weak_servos, torque=_shoulder_friction
        ),
        "rotary pendulum": Machine(
            model="rotary_pendulum",
            step=0.002,
            rows=8000,
            command=(0.02,),
            memory=0.1,
            hold=(0.01,),
            encoder=(2.0 * np.pi / 2048,) * 2,
            filter_time=0.004,
            change=_small_losses,
        ),
        "geared arm": Machine(
            model="geared_arm", step=0.005, command=(3.0,), memory=0.3, hold=(1.0,), brake=(0.1,), torque=_geared_arm
        ),
        "six-joint arm": Machine(
            model="six_joint_arm",
            step=0.008,
            command=(20.0, 40.0, 20.0, 5.0, 4.0, 2.0),
            memory=1.0,
            hold=(40.0, 200.0, 60.0, 12.0, 8.0, 3.0),
            brake=(5.0, 20.0, 5.0, 0.5, 0.5, 0.2),
            encoder=(2.0 * np.pi / 2**15,) * 6,
            filter_time=0.004,
            change=_tool,
            torque=_arm_friction,
        ),
        "linear axis": Machine(
            model="linear_axis",
            step=0.002,
            command=(4.0,),
            memory=0.2,
            hold=(60.0,),
            brake=(2.0,),
            encoder=(1e-6,),
            filter_time=0.004,
            torque=_axis,
        ),
    }
)
