"""Arms of one or three joints with position servos, whose gears and motors do what the model lacks.

Their physics is written here with MuJoCo alone, not with the effects of the library: friction is computed at each
physics step as BAM does (github.com/Rhoban/bam), and play is a second hinge between motor and link.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields, replace

import mujoco
import numpy as np
from chains import Chain, Joint, axis, mjcf, references, torque_of_gravity

STEP = 0.01  # s, control step
SUBSTEPS = 40  # physics steps of reality per control step
BANDWIDTH, DAMPING_RATIO = (8.0, 20.0), (0.3, 0.6)  # of the servos, in rad/s and of critical
ROTOR = (0.2, 1.0)  # in inertias of the hanging arm about the joint
FRICTION, DAMPING = (0.02, 0.08), (0.01, 0.04)  # in largest torques of gravity, and in these times s/rad


@dataclass(frozen=True, kw_only=True)
class Servo(Joint):
    """A joint with a position servo, and what gears and motors do beside friction, damping and a rotor.

    Args:
        load: friction per load of the gear (M3 of Duclusaud et al., ICRA 2025).
        rest: further friction at rest, in N·m (M2).
        rest_load: the same per load (M4).
        speed: velocity at which friction at rest has gone, in rad/s.
        exponent: exponent of this decrease.
        play: play between motor and link, in rad; the servo measures the link.
        lead: derivative gain on the target over the stiffness, in s.
        stall: largest torque at rest, in N·m.
        no_load: velocity at which no torque is left, in rad/s.
        delay: time by which commands act late, in s.
        gain: factor on the stiffness of the data sheet.
        lag: time constant of a filter of the commands, in s.
        dead: error up to which the servo makes no torque, in rad.
        load_mass: mass beside the link, on a box that the model lacks, in kg.
        load_place: place of the box along the link, as a share of its length.
        load_offset: its distance to the side, as a share of the link's length.
    """

    load: float = 0.0
    rest: float = 0.0
    rest_load: float = 0.0
    speed: float = 1.0
    exponent: float = 1.0
    play: float = 0.0
    lead: float = 0.0
    stall: float = math.inf
    no_load: float = math.inf
    delay: float = 0.0
    gain: float = 1.0
    lag: float = 0.0
    dead: float = 0.0
    load_mass: float = 0.0
    load_place: float = 0.5
    load_offset: float = 0.0


@dataclass(frozen=True)
class Arm:
    """An arm that hangs from its first joint.

    Args:
        servos: from the base to the tip.
    """

    servos: tuple[Servo, ...]

    @classmethod
    def draw(cls, rng: np.random.Generator, count: int) -> Arm:
        """Draw an arm; its friction and servos have the size of the inertias and weights that they move."""
        links = [Servo(length=float(rng.uniform(0.08, 0.2)), mass=float(rng.uniform(0.1, 0.6))) for _ in range(count)]
        inertias = mujoco.MjModel.from_xml_string(cls(tuple(links)).xml()).dof_M0
        servos = []
        for index, (link, inertia) in enumerate(zip(links, inertias.tolist(), strict=True)):
            weight = torque_of_gravity(links[index:])
            rotor = inertia * float(rng.uniform(*ROTOR))
            bandwidth, ratio = rng.uniform(*BANDWIDTH), rng.uniform(*DAMPING_RATIO)
            stiffness = float((inertia + rotor) * bandwidth**2 + 2.0 * weight)
            servo = replace(
                link,
                stiffness=stiffness,
                brake=float(2.0 * ratio * math.sqrt(stiffness * (inertia + rotor))),
                friction=float(weight * rng.uniform(*FRICTION)),
                damping=float(weight * rng.uniform(*DAMPING)),
                rotor=rotor,
            )
            servos.append(servo)
        return cls(tuple(servos))

    @property
    def names(self) -> list[str]:
        """The joints' names."""
        return Chain(self.servos, servos=True).names

    def xml(self, complete: bool = False) -> str:
        """The MJCF model: servos without friction and rotors; or complete, with motors and with play."""
        if not complete:
            return Chain(self.servos, servos=True).xml(step=STEP)
        hinges = []
        for index, servo in enumerate(self.servos):
            losses = f'damping="{servo.damping}" frictionloss="{servo.friction}" armature="{servo.rotor}"'
            hinges.append(f'<joint name="joint{index}" axis="{axis(index)}" {losses}/>')
            if servo.play:
                stop = f'limited="true" range="{-servo.play / 2.0} {servo.play / 2.0}" solreflimit="0.001 1"'
                hinges[-1] += f'<joint name="play{index}" axis="{axis(index)}" {stop}/>'
            if servo.load_mass:
                x, z = servo.load_offset * servo.length, -servo.load_place * servo.length
                size = f"{0.3 * servo.length} {0.1 * servo.length} {0.2 * servo.length}"
                box = f'pos="{x} {0.5 * x} {z}" euler="0.5 0.5 0" size="{size}" mass="{servo.load_mass}"'
                hinges[-1] += f'<geom name="box{index}" type="box" {box}/>'
        drives = [f'<motor joint="{name}"/>' for name in self.names]
        return mjcf(self.servos, hinges, drives, STEP / SUBSTEPS)

    def record(self, rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """One run from rest: positions and velocities, (rows + 1, 2 n), and the targets of each row, (rows, n)."""
        model = mujoco.MjModel.from_xml_string(self.xml(complete=True))
        data, targets = mujoco.MjData(model), references(rows, model.nu, np.random.default_rng(seed), STEP)
        motors, plays = _dofs(model, "joint", len(self.servos)), _dofs(model, "play", len(self.servos))
        values = {one.name: np.array([getattr(servo, one.name) for servo in self.servos]) for one in fields(Servo)}
        waiting = [deque([0.0] * round(servo.delay * SUBSTEPS / STEP)) for servo in self.servos]
        before = targets[0]
        filtered, step = np.array(before), STEP / SUBSTEPS
        share = -np.expm1(-step / np.maximum(values["lag"], 1e-9))  # of the way to a command in a physics step

        def state() -> np.ndarray:
            moved = [np.where(plays >= 0, part[plays], 0.0) + part[motors] for part in (data.qpos, data.qvel)]
            return np.concatenate(moved)

        observed = [state()]
        for target in targets:
            led = target + values["lead"] * (target - before) / STEP
            before = target
            for _ in range(SUBSTEPS):
                for queue, command in zip(waiting, led, strict=True):
                    queue.append(command)
                late = np.array([queue.popleft() for queue in waiting])
                filtered += share * (late - filtered)
                position, velocity = np.split(state(), 2)
                error = filtered - position
                error -= np.clip(error, -values["dead"], values["dead"])
                torque = values["gain"] * values["stiffness"] * error - values["brake"] * velocity
                ratio = data.qvel[motors] / values["no_load"]
                data.ctrl[:] = np.clip(torque, -values["stall"] * (1.0 + ratio), values["stall"] * (1.0 - ratio))
                model.dof_frictionloss[motors] = _friction(values, data.ctrl, data, motors)
                mujoco.mj_step(model, data)
            observed.append(state())
        return np.array(observed), targets


def _friction(values: dict, torque: np.ndarray, data: mujoco.MjData, motors: np.ndarray) -> np.ndarray:
    """Dry friction of each joint, (n), in N·m: model M4 of Duclusaud et al."""
    load = np.abs(torque + data.qfrc_bias[motors])
    at_rest = np.exp(-(np.abs(data.qvel[motors] / values["speed"]) ** values["exponent"]))
    return values["friction"] + values["load"] * load + at_rest * (values["rest"] + values["rest_load"] * load)


def _dofs(model: mujoco.MjModel, name: str, count: int) -> np.ndarray:
    """Degrees of freedom of numbered joints, (count); -1 where the model has none."""
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"{name}{index}") for index in range(count)]
    return np.array([model.jnt_dofadr[one] if one >= 0 else -1 for one in ids])
