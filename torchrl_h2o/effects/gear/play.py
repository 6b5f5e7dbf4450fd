"""Play (backlash) in the gear between a motor and its link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects.effect import VaryingEffect
from torchrl_h2o.effects.gear.loads import JointActuators
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Indices
from torchrl_h2o.effects.states import BatchedForce, States, Variation

_CREEP = 1e-3  # rad/s, below which the rotor's dry friction fades
_ROTOR = 0.05  # inertia of the rotor of a model without armature, over the inertia that the joint moves
_OF_JOINT = ("dof_armature", "dof_frictionloss", "dof_damping")
_OF_ACTUATOR = ("actuator_gainprm", "actuator_biasprm")


@dataclass(frozen=True)
class GearPlay(VaryingEffect):
    """Play (backlash) in the gear between a motor and its link, behind which the servo measures the position.

    When the torque on the teeth would change its sign, they part: the link moves without motor, rotor and friction, and
    the rotor crosses the play before it pushes the link again. Armature, friction and damping of the joint belong to
    the rotor. A model without armature gets a rotor of a twentieth of the inertia that the joint moves, for the time of
    the crossing. Where the side on which the teeth touch is not known from the steps before, a simulation starts with
    them in contact, on the side on which motor, weight and inertia press them.

    Args:
        width: the angle that the link can turn while the motor rests, in rad.
        actuators: indices of the actuators; all by default.

    Raises:
        ValueError: when put into a model in which one of them is no motor or servo on a single joint.

    Examples:
        >>> GearPlay(0.02).describe()
        'play of 0.02 rad in the gears of all actuators'

    Source: M. Nordin, P.-O. Gutman, *Controlling mechanical systems with backlash - a survey*, Automatica 38 (2002):
    dead zone with a stiff shaft.
    """

    wording: ClassVar[str] = "play of {width} in the gears of {actuators}"
    acts_last: ClassVar[bool] = True
    width: float = parameter(unit="rad", bounds=(0.0, 1.0), neutral=0.0)
    actuators: Indices = None

    def vary(self, model: mujoco.MjModel, weight: BatchedForce) -> Variation:
        motors, step, half = JointActuators(model, self.actuators), model.opt.timestep, 0.5 * self.width
        dofs = motors.dofs
        mobility = model.dof_invweight0[dofs]
        crossing = np.where(model.dof_armature[dofs] > 0.0, model.dof_armature[dofs], _ROTOR * model.dof_M0[dofs])
        teeth = _Teeth(len(dofs))

        def apply(states: States, values: dict[str, np.ndarray]) -> np.ndarray:
            armature, dry, viscous = (values[field][:, dofs] for field in _OF_JOINT)

            def losses(velocity: np.ndarray) -> np.ndarray:
                return dry * np.tanh(velocity / _CREEP) + viscous * velocity

            velocity = states.qvel[:, dofs]
            torque = motors.gear * motors.forces(motors.inputs(states), states)
            pushing = torque - losses(velocity)
            if len(teeth.time) != len(velocity):
                teeth.write(np.full((len(velocity), teeth.size), np.nan))
            begins = ~np.isclose(states.time - teeth.time, step)
            if begins.any():
                before = velocity - (pushing + weight(states)[:, dofs]) * mobility * step
                teeth.link[begins], teeth.pushing[begins] = before[begins], pushing[begins]
            # the acceleration of the step before, and what the torque that has changed since adds to it
            acceleration = (velocity - teeth.link) / step + (pushing - teeth.pushing) * mobility
            on_teeth = pushing - armature * np.nan_to_num(acceleration)
            unknown = begins[:, None] & (np.isfinite(teeth.time)[:, None] | np.isnan(teeth.side))
            side = np.where(unknown, np.where(on_teeth >= 0.0, 1.0, -1.0), teeth.side)
            leave = side * on_teeth < 0.0
            free = leave | (side == 0.0)
            rotor = np.where(leave, velocity, teeth.rotor)
            rotor = np.where(free, rotor + (torque - losses(rotor)) / crossing * step, velocity)
            offset = np.where(leave, half * side, teeth.offset) + (rotor - velocity) * step
            meet = free & (np.abs(offset) >= half)
            free &= ~meet
            teeth.side, teeth.offset = np.where(meet, np.sign(offset), np.where(free, 0.0, side)), offset
            teeth.rotor, teeth.pushing, teeth.time = rotor, pushing, states.time.copy()
            teeth.link = np.where(meet, np.nan, velocity)  # the impact is no acceleration that parts the teeth
            world, own = np.nonzero(free)
            for field in _OF_JOINT:
                values[field][world, dofs[own]] = 0.0
            for field in _OF_ACTUATOR:
                values[field][world, motors.indices[own]] = 0.0
            return motors.on_joints(np.where(meet, armature * (rotor - velocity) / step, 0.0) / motors.gear)

        return Variation((*_OF_JOINT, *_OF_ACTUATOR), apply, teeth)


class _Teeth:
    """Where the rotors of k motors were relative to their links at the last call, in B worlds.

    Args:
        motors: k.

    Attributes:
        side: -1 or 1 where the teeth touch, 0 where they are apart, NaN where that is not known, (B, k).
        offset: rotor minus link, in rad, (B, k).
        rotor: velocity of the rotor, in rad/s, (B, k).
        link: velocity of the link, in rad/s, (B, k); NaN before an impact.
        pushing: torque of the rotor without its losses, in N·m, (B, k).
        time: in s, (B,); NaN before the first call.
    """

    def __init__(self, motors: int):
        self.size = 3 * motors
        self.write(np.empty((0, self.size)))

    def read(self) -> np.ndarray:
        return np.hstack([self.side, self.offset, self.rotor])

    def write(self, remembered: np.ndarray) -> None:
        self.side, self.offset, self.rotor = np.split(remembered, 3, axis=1)
        self.link, self.pushing = np.full((2, *self.side.shape), np.nan)
        self.time = np.full(len(remembered), np.nan)
