"""Effects on the position servos and the filters of a model's actuators."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import ANY_SIZE, parameter
from torchrl_h2o.effects.selection import Indices


@dataclass(frozen=True)
class ServoStiffness(ModelEffect):
    """Scales the stiffness of position servos: their torque per radian between the command and the position.

    The damping of the servos stays as it is, unless the model gives it as a damping ratio.

    Args:
        scale: factor on the stiffness, which MJCF calls ``kp``.
        actuators: indices of the actuators; all by default. Actuators that are not position servos are skipped.

    Raises:
        ValueError: when put into a model that has no such actuator.

    Examples:
        >>> ServoStiffness(0.7).describe()
        'stiffness of the servos of all actuators × 0.7'
    """

    wording: ClassVar[str] = "stiffness of the servos of {actuators} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=1.0)
    actuators: Indices = None

    def edit(self, spec: mujoco.MjSpec) -> None:
        servos = [actuator for actuator in _chosen(spec, self.actuators) if is_servo(actuator)]
        if not servos:
            raise ValueError("none of the actuators is a position servo, whose stiffness could be scaled")
        for servo in servos:
            servo.gainprm[0] *= self.scale
            servo.biasprm[1] *= self.scale


@dataclass(frozen=True)
class ServoDamping(ModelEffect):
    """Derivative gain of position servos: a torque opposed to the velocity, within the limit of the servo's torque.

    Args:
        damping: addition to the servos' own damping, in MJCF ``kv``, in N·m·s/rad; a negative value reduces it.
        actuators: indices of the actuators; all by default. Actuators that are not position servos are skipped.

    Raises:
        ValueError: when put into a model that has no such actuator, or if the damping would become negative.

    Examples:
        >>> ServoDamping(0.1).describe()
        'damping of the servos of all actuators + 0.1 N·m·s/rad'
    """

    wording: ClassVar[str] = "damping of the servos of {actuators} + {damping}"
    damping: float = parameter(unit="N·m·s/rad", bounds=ANY_SIZE, neutral=0.0)
    actuators: Indices = None

    def edit(self, spec: mujoco.MjSpec) -> None:
        servos = [actuator for actuator in _chosen(spec, self.actuators) if is_servo(actuator)]
        if not servos:
            raise ValueError("none of the actuators is a position servo, whose damping could be changed")
        for servo in servos:
            own = -float(servo.biasprm[2])
            if own + self.damping < 0.0:
                raise ValueError(f"servo '{servo.name}' has a damping of {own:g}, less than {-self.damping:g}")
            servo.biasprm[2] = -(own + self.damping)


@dataclass(frozen=True)
class ActuatorTimeConstant(ModelEffect):
    """Scales the time constants of the filters in a model's actuators.

    :class:`ActionLag` adds a filter; this effect makes one that the model has faster or slower.

    Args:
        scale: factor on the time constant, which MJCF calls ``timeconst`` or ``dynprm``.
        actuators: indices of the actuators; all by default. Actuators without a filter are skipped.

    Raises:
        ValueError: when put into a model that has no such actuator.

    Examples:
        >>> ActuatorTimeConstant(0.1).describe()
        'time constant of the filters of all actuators × 0.1'
    """

    wording: ClassVar[str] = "time constant of the filters of {actuators} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 100.0), neutral=1.0)
    actuators: Indices = None

    def edit(self, spec: mujoco.MjSpec) -> None:
        filters = [actuator for actuator in _chosen(spec, self.actuators) if is_filter(actuator)]
        if not filters:
            raise ValueError("none of the actuators has a filter, whose time constant could be scaled")
        for actuator in filters:
            actuator.dynprm[0] *= self.scale


def _chosen(spec: mujoco.MjSpec, actuators: Indices) -> list[mujoco.MjsActuator]:
    count = len(spec.actuators)
    chosen = range(count) if actuators is None else actuators
    if any(index >= count for index in chosen):
        raise ValueError(f"{chosen} are not all indices of {count} actuators")
    return [spec.actuators[index] for index in chosen]


def is_filter(actuator: mujoco.MjsActuator) -> bool:
    """Whether the command of an actuator passes a filter of first order."""
    filters = (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    return actuator.dyntype in filters and actuator.dynprm[0] > 0.0


def is_velocity_servo(actuator: mujoco.MjsActuator) -> bool:
    """Whether the force of an actuator is proportional to the difference of its command and its velocity alone."""
    return not is_servo(actuator) and bool(actuator.biasprm[2] != 0.0 and actuator.gainprm[0] == -actuator.biasprm[2])


def is_servo(actuator: mujoco.MjsActuator) -> bool:
    """Whether the force of an actuator is proportional to the difference of its command and its position."""
    affine = actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    return bool(affine and actuator.biasprm[1] != 0.0 and actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED)
