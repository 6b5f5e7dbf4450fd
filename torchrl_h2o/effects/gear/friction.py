"""Dry friction of gears: it grows with the load on the teeth, and falls once the joint moves."""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import NO_NAMES, EntryNames, VaryingEffect
from torchrl_h2o.effects.gear.loads import JointActuators
from torchrl_h2o.effects.parameter import ANY_AMOUNT, parameter
from torchrl_h2o.effects.selection import Names
from torchrl_h2o.effects.states import BatchedForce, States, Variation

_SHARES = (0.0, 10.0)


@dataclass(frozen=True)
class LoadFriction(VaryingEffect):
    r"""Dry friction in joints that grows with the load on the gear.

    The friction exceeds the model's own by :math:`K |\tau_m - e\,\tau_w|`. Here :math:`\tau_m` is the torque of the
    joint's actuators and :math:`\tau_w` that of the weight. A motor that holds a weight loads the gear from both sides.
    Contacts, inertia and Coriolis forces do not count as load.

    Args:
        share: :math:`K`, the friction per load.
        weight: :math:`e`, the share of the weight's torque that counts. 1 is a gear whose efficiency is the same in
            both directions.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or if an actuator of one of them is not linear.

    Examples:
        >>> LoadFriction(0.07, joints="*knee*").describe()
        'dry friction of joints *knee* + 0.07 of the load'

    Source: M. Duclusaud, G. Passault, V. Padois, O. Ly, *Extended Friction Models for the Physics Simulation of Servo
    Actuators*, ICRA 2025, arXiv 2410.08650: :math:`K_l` of its model M3; with ``weight`` also :math:`K_m` and
    :math:`K_e / K_m` of M5.
    """

    amounts: ClassVar[tuple[str, ...]] = ("share",)
    wording: ClassVar[str] = "dry friction of {joints} + {share} of the load"
    share: float = parameter(unit="1", bounds=_SHARES, neutral=0.0)
    weight: float = parameter(unit="1", bounds=_SHARES, neutral=1.0)
    joints: Names = "*"

    def describe(self, names: EntryNames = NO_NAMES) -> str:
        return super().describe(names) + _details(self)

    def vary(self, model: mujoco.MjModel, weight: BatchedForce) -> Variation:
        chosen, actuators = _mask(model, self.joints), JointActuators.on(model, self.joints)

        def friction(states: States) -> np.ndarray:
            carried = self.weight * weight(states) if self.weight else 0.0
            return self.share * chosen * np.abs(actuators.torques(states) - carried)

        return _added(friction)


@dataclass(frozen=True)
class StribeckFriction(VaryingEffect):
    r"""Dry friction in joints that is larger at rest than in motion.

    The friction exceeds the model's own by
    :math:`e^{-|\dot q / v_s|^\alpha} \left(\tau_s + K_s |\tau_m - e\,\tau_w| + q\right)`, with the torques of
    :class:`LoadFriction`. Where motor and weight pull in different directions, q is :math:`Q_w \tau_w^2` if the motor
    is the stronger one, and :math:`Q_m \tau_m^2` if the weight is.

    Args:
        torque: :math:`\tau_s`, by which friction at rest exceeds that in motion, in N·m.
        speed: :math:`v_s`, at which most of it has gone, in rad/s; by default, it never goes.
        share: :math:`K_s`, the same per load.
        weight: :math:`e`, as for :class:`LoadFriction`.
        exponent: :math:`\alpha`.
        motor_square: :math:`Q_m`, in 1/(N·m).
        weight_square: :math:`Q_w`, in 1/(N·m).
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or if an actuator of one of them is not linear.

    Examples:
        >>> StribeckFriction(0.02, 0.5, joints="*knee*").describe()
        'dry friction of joints *knee* + 0.02 N·m and 0 of the load below about 0.5 rad/s'

    Source: Duclusaud et al. (see :class:`LoadFriction`), :math:`K_{cs}` and :math:`K_{ls}` of its models M2, M4 and M5,
    and the quadratic terms of M6 as in the authors' code (github.com/Rhoban/bam, ``bam/model.py``); the exponent 2 is
    that of C. Canudas de Wit, H. Olsson, K. J. Åström, P. Lischinsky, *A New Model for Control of Systems with
    Friction*, IEEE Transactions on Automatic Control 40 (1995), Eq. (5).
    """

    amounts: ClassVar[tuple[str, ...]] = ("torque", "share", "motor_square", "weight_square")
    wording: ClassVar[str] = "dry friction of {joints} + {torque} and {share} of the load below about {speed}"
    torque: float = parameter(unit="N·m", bounds=ANY_AMOUNT, neutral=0.0)
    speed: float = parameter(unit="rad/s", bounds=(1e-3, math.inf), neutral=math.inf)
    share: float = parameter(unit="1", bounds=_SHARES, neutral=0.0)
    weight: float = parameter(unit="1", bounds=_SHARES, neutral=1.0)
    exponent: float = parameter(unit="1", bounds=(0.1, 10.0), neutral=2.0)
    motor_square: float = parameter(unit="1/(N·m)", bounds=ANY_AMOUNT, neutral=0.0)
    weight_square: float = parameter(unit="1/(N·m)", bounds=ANY_AMOUNT, neutral=0.0)
    joints: Names = "*"

    def describe(self, names: EntryNames = NO_NAMES) -> str:
        return super().describe(names) + _details(self)

    def vary(self, model: mujoco.MjModel, weight: BatchedForce) -> Variation:
        chosen = _mask(model, self.joints)
        depends_on_load = self.share or self.motor_square or self.weight_square
        actuators = JointActuators.on(model, self.joints) if depends_on_load else None

        def friction(states: States) -> np.ndarray:
            at_rest = np.exp(-(np.abs(states.qvel / self.speed) ** self.exponent))
            loaded = self._loaded(actuators.torques(states), weight(states)) if actuators else 0.0
            return at_rest * chosen * (self.torque + loaded)

        return _added(friction)

    def _loaded(self, motor: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """The part of the friction at rest that the torques of motors and weight cause, (B, nv)."""
        by_motor = self.weight_square * weight**2 * (np.abs(motor) > np.abs(weight))
        by_weight = self.motor_square * motor**2 * (np.abs(motor) < np.abs(weight))
        squares = (by_motor + by_weight) * (np.sign(motor) != np.sign(weight))
        return self.share * np.abs(motor - self.weight * weight) + squares


def _added(friction: BatchedForce) -> Variation:
    """The variation that adds a friction, (B, nv), to that of the model."""

    def apply(states: States, values: dict[str, np.ndarray]) -> float:
        values["dof_frictionloss"] += friction(states)
        return 0.0

    return Variation(("dof_frictionloss",), apply)


def _details(effect: LoadFriction | StribeckFriction) -> str:
    """Words for what is rarely set."""
    names = ("weight", "exponent", "motor_square", "weight_square")
    rare = {name: effect.parameters[name] for name in names if name in effect.parameters}
    return "".join(f", {name.replace('_', ' ')} {one}" for name, one in rare.items() if one.value != one.neutral)


def _mask(model: mujoco.MjModel, joints: Names) -> np.ndarray:
    """1 for the degrees of freedom of joints, 0 for others, (nv)."""
    mask = np.zeros(model.nv)
    mask[selection.joint_dofs(model, joints)] = 1.0
    return mask
