"""Chains of driven joints, each with a friction, a damping and a rotor of its own, behind one delay.

Their physics is written here with MuJoCo alone, not with the effects of the library.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

STEP = 0.005  # s, control step
MODEL_STEPS, SUBSTEPS = 4, 20  # physics steps per control step, of the model and of reality
GRAVITY = 9.81
SIZES = (6, 12)  # fewest and most joints
ROTOR = (0.5, 3.0)  # in inertias of the straight chain about the joint
FRICTION, DAMPING = (0.03, 0.12), (0.02, 0.08)  # in largest torques of gravity, and in these times s/rad
SERVO, CONTROLLER = (12.0, 25.0), (6.0, 10.0)  # rad/s, their bandwidths; a controller acts as late as its motors
DAMPING_RATIO = (0.3, 0.6)  # of both, of critical
DELAY = (8, 60)  # physics steps of reality: 2 to 15 ms
SINES, FREQUENCY, SWING = 4, (0.1, 1.5), 0.25  # of each joint's reference: number, Hz, and amplitude of one in rad
LEVEL, HOLD, SMOOTHING = 0.3, (1.0, 3.0), 0.05  # of its steps: largest in rad, seconds between them, filter in s


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint with its link and its drive.

    Args:
        length: length of the link, in m.
        mass: mass of the link, in kg.
        friction: dry friction, in N·m, which the model lacks.
        damping: viscous friction, in N·m·s/rad, which the model lacks.
        rotor: inertia of the drive, in kg·m², which the model lacks.
        stiffness: gain of the servo or controller on positions, in N·m/rad.
        brake: its gain on velocities, in N·m·s/rad.
    """

    length: float
    mass: float
    friction: float = 0.0
    damping: float = 0.0
    rotor: float = 0.0
    stiffness: float = 1.0
    brake: float = 0.0


@dataclass(frozen=True)
class Chain:
    """A chain that hangs from its first joint.

    Args:
        joints: from the base to the tip.
        servos: whether position servos drive it, whose commands are angles; torque motors otherwise.
        delay: time by which commands act late, in s.
    """

    joints: tuple[Joint, ...]
    servos: bool
    delay: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, servos: bool, sizes: tuple[int, int] = SIZES) -> Chain:
        """Draw a chain; its losses and drives have the size of the inertias and weights that they move."""
        count = int(rng.integers(sizes[0], sizes[1] + 1))
        thinner, shorter = rng.uniform(0.8, 0.95), rng.uniform(0.85, 0.95)
        masses = rng.uniform(1.5, 4.0) * thinner ** np.arange(count) * rng.uniform(0.8, 1.2, count)
        lengths = rng.uniform(0.15, 0.3) * shorter ** np.arange(count)
        links = [
            Joint(length=length, mass=mass) for length, mass in zip(lengths.tolist(), masses.tolist(), strict=True)
        ]
        inertias = mujoco.MjModel.from_xml_string(cls(tuple(links), servos).xml()).dof_M0
        joints = []
        for index, (link, inertia) in enumerate(zip(links, inertias.tolist(), strict=True)):
            weight = torque_of_gravity(links[index:])
            rotor = inertia * math.exp(rng.uniform(*np.log(ROTOR)))
            moved, bandwidth = inertia + rotor, rng.uniform(*(SERVO if servos else CONTROLLER))
            drive = {"stiffness": moved * bandwidth**2, "brake": 2.0 * rng.uniform(*DAMPING_RATIO) * moved * bandwidth}
            friction, damping = weight * rng.uniform(*FRICTION), weight * rng.uniform(*DAMPING)
            joints.append(replace(link, friction=friction, damping=damping, rotor=rotor, **drive))
        return cls(tuple(joints), servos, STEP / SUBSTEPS * int(rng.integers(DELAY[0], DELAY[1] + 1)))

    @property
    def names(self) -> list[str]:
        """The joints' names."""
        return [f"joint{index}" for index in range(len(self.joints))]

    def xml(self, complete: bool = False, step: float = STEP) -> str:
        """The MJCF model, without friction, damping and rotors unless it is to be complete."""
        hinges, drives = [], []
        for index, joint in enumerate(self.joints):
            lacks = f'frictionloss="{joint.friction}" damping="{joint.damping}" armature="{joint.rotor}"'
            hinges.append(f'<joint name="joint{index}" axis="{axis(index)}" {lacks if complete else ""}/>')
            kind = f'position kp="{joint.stiffness}" kv="{joint.brake}"' if self.servos else "motor"
            drives.append(f'<{kind} name="drive{index}" joint="joint{index}"/>')
        return mjcf(self.joints, hinges, drives, step / MODEL_STEPS)

    def record(self, rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """One run from rest: positions and velocities, (rows + 1, 2 n), and the commands of each row, (rows, n)."""
        model = mujoco.MjModel.from_xml_string(self.xml(complete=True))
        model.opt.timestep = STEP / SUBSTEPS
        data, targets = mujoco.MjData(model), references(rows, model.nu, np.random.default_rng(seed), STEP)
        stiffness, brake = np.array([(joint.stiffness, joint.brake) for joint in self.joints]).T
        waiting = deque([np.zeros(model.nu)] * round(self.delay * SUBSTEPS / STEP))
        observed, commands = [np.concatenate([data.qpos, data.qvel])], []
        for reference in targets:
            torque = stiffness * (reference - data.qpos) - brake * data.qvel
            commands.append(reference if self.servos else torque)
            for _ in range(SUBSTEPS):
                waiting.append(commands[-1])
                data.ctrl[:] = waiting.popleft()
                mujoco.mj_step(model, data)
            observed.append(np.concatenate([data.qpos, data.qvel]))
        return np.array(observed), np.array(commands)


def axis(index: int) -> str:
    """Axis of a joint: those of neighbours are perpendicular, so that a chain moves in three dimensions."""
    return ("0 1 0", "1 0 0")[index % 2]


def mjcf(joints: Sequence[Joint], hinges: Sequence[str], drives: Sequence[str], step: float) -> str:
    """The MJCF model of a chain with physics steps in s, from the elements of its hinges and actuators."""
    body = ""
    for index, joint in reversed(list(enumerate(joints))):
        before = joints[index - 1].length if index else 0.0
        link = f'<geom fromto="0 0 0 0 0 {-joint.length}" size="{0.12 * joint.length}" mass="{joint.mass}"/>'
        body = f'<body name="link{index}" pos="0 0 {-before}">{hinges[index]}{link}{body}</body>'
    return (
        '<mujoco model="chain"><compiler angle="radian" autolimits="false"/>'
        f'<option timestep="{step}" gravity="0 0 {-GRAVITY}" integrator="implicitfast"/>'
        '<default><geom type="capsule" contype="0" conaffinity="0"/></default>'
        f"<worldbody>{body}</worldbody><actuator>{''.join(drives)}</actuator></mujoco>"
    )


def torque_of_gravity(links: Sequence[Joint]) -> float:
    """Torque of gravity at the first of some links, in N·m, if all were stretched out horizontally."""
    torque, reach = 0.0, 0.0
    for link in links:
        torque += GRAVITY * link.mass * (reach + 0.5 * link.length)
        reach += link.length
    return torque


def references(rows: int, joints: int, rng: np.random.Generator, step: float) -> np.ndarray:
    """Angles to move to, (rows, joints), in rad: sines, and steps behind a filter; they begin at 0."""
    time = step * np.arange(rows)
    moves = np.zeros((rows, joints))
    left = math.exp(-step / SMOOTHING)
    for joint in range(joints):
        frequency = np.exp(rng.uniform(*np.log(FREQUENCY), SINES))
        phase = rng.uniform(0.0, 2.0 * math.pi, SINES)
        sines = SWING * np.sin(2.0 * math.pi * frequency * time[:, None] + phase).sum(1)
        changes = np.cumsum(rng.uniform(*HOLD, math.ceil(time[-1] / HOLD[0])))
        levels = rng.uniform(-LEVEL, LEVEL, len(changes) + 1)[np.searchsorted(changes, time)]
        move = 0.0
        for row, target in enumerate(np.clip(sines + levels, -1.1, 1.1)):
            moves[row, joint] = move
            move = left * move + (1.0 - left) * target
    return moves
