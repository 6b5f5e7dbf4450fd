"""Effects on joints: range, damping, dry friction, armature and springs.

For sliding joints, N·m stands for N, rad for m and kg·m² for kg.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import ANY_SIZE, parameter
from torchrl_h2o.effects.selection import Names

LOCKED = 0.001  # factor on a joint's range that leaves no motion


@dataclass(frozen=True)
class JointRange(ModelEffect):
    """Scales both ends of the range of joints; a joint whose range is next to nothing is locked near zero.

    Args:
        scale: factor on the ends of the range; :data:`LOCKED` for a joint that does not move.
        joints: name patterns of the joints; joints without a range are skipped.

    Raises:
        ValueError: when put into a model that has no such joint with a range.

    Examples:
        >>> JointRange(0.5, joints="*thigh*").describe()
        'range of joints *thigh* × 0.5'
        >>> JointRange(LOCKED, joints="*thigh*").describe()
        'range of joints *thigh* × 0.001'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gaps ``broken_thigh`` and ``flexible_thigh``.
    """

    wording: ClassVar[str] = "range of {joints} × {scale}"
    scale: float = parameter(unit="1", bounds=(LOCKED, 10.0), neutral=1.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in _those_with("range", selection.joints(spec, self.joints)):
            joint.range *= self.scale


@dataclass(frozen=True)
class JointDamping(ModelEffect):
    """Viscous friction in joints: a torque proportional to the velocity and opposed to it.

    Args:
        damping: addition to the joints' own damping, in N·m·s/rad; a negative value reduces it.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or if the damping would become negative.

    Examples:
        >>> JointDamping(0.1, joints="*wheel*").describe()
        'damping of joints *wheel* + 0.1 N·m·s/rad'
    """

    wording: ClassVar[str] = "damping of {joints} + {damping}"
    damping: float = parameter(unit="N·m·s/rad", bounds=ANY_SIZE, neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            # the entries after the first are the coefficients of higher powers of the velocity
            joint.damping[0] = _added(joint, "damping", joint.damping[0], self.damping)


@dataclass(frozen=True)
class JointFrictionLoss(ModelEffect):
    """Dry (Coulomb) friction in joints: a torque of constant magnitude opposed to the velocity.

    Args:
        torque: addition to the joints' own ``frictionloss``, in N·m; a negative value reduces it.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or if the friction would become negative.

    Examples:
        >>> JointFrictionLoss(0.2, joints="*wheel*").describe()
        'dry friction of joints *wheel* + 0.2 N·m'
    """

    wording: ClassVar[str] = "dry friction of {joints} + {torque}"
    torque: float = parameter(unit="N·m", bounds=ANY_SIZE, neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            joint.frictionloss = _added(joint, "frictionloss", joint.frictionloss, self.torque)


@dataclass(frozen=True)
class Armature(ModelEffect):
    """Rotor inertia of the drives, reflected to the joint (armature).

    Args:
        inertia: addition to the joints' own ``armature``, in kg·m²; a negative value reduces it.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or if the armature would become negative.

    Examples:
        >>> Armature(0.05, joints="*wheel*").describe()
        'armature of joints *wheel* + 0.05 kg·m²'
    """

    wording: ClassVar[str] = "armature of {joints} + {inertia}"
    inertia: float = parameter(unit="kg·m²", bounds=ANY_SIZE, neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            joint.armature = _added(joint, "armature", joint.armature, self.inertia)


@dataclass(frozen=True)
class JointStiffness(ModelEffect):
    """Scales the stiffness of joints.

    Args:
        scale: factor on the stiffness.
        joints: name patterns of the joints; joints without a spring are skipped.

    Raises:
        ValueError: when put into a model that has no such joint with a spring.

    Examples:
        >>> JointStiffness(0.0, joints="*foot*").describe()
        'stiffness of joints *foot* × 0'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gap ``soft_feet``.
    """

    wording: ClassVar[str] = "stiffness of {joints} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=1.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in _those_with("stiffness", selection.joints(spec, self.joints)):
            joint.stiffness *= self.scale


@dataclass(frozen=True)
class JointSpring(ModelEffect):
    """A spring on joints, as of a cable or a hose: a torque proportional to the deflection.

    The rest position is the joint's ``springref``, which is zero unless the model sets it.

    Args:
        stiffness: addition to the joints' own stiffness, in N·m/rad; a negative value reduces it.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or if the stiffness would become negative.

    Examples:
        >>> JointSpring(0.5, joints="*hip*").describe()
        'stiffness of joints *hip* + 0.5 N·m/rad'
    """

    wording: ClassVar[str] = "stiffness of {joints} + {stiffness}"
    stiffness: float = parameter(unit="N·m/rad", bounds=ANY_SIZE, neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            # the entries after the first are the coefficients of higher powers of the angle
            joint.stiffness[0] = _added(joint, "stiffness", joint.stiffness[0], self.stiffness)


@dataclass(frozen=True)
class JointRest(ModelEffect):
    """Shifts the rest position of the springs of joints.

    Args:
        angle: addition to the joints' ``springref``, in rad.
        joints: name patterns of the joints; joints without a spring are skipped.

    Raises:
        ValueError: when put into a model that has no such joint with a spring.

    Examples:
        >>> JointRest(0.1, joints="*foot*").describe()
        'rest of joints *foot* + 0.1 rad'
    """

    wording: ClassVar[str] = "rest of {joints} + {angle}"
    angle: float = parameter(unit="rad", bounds=(-10.0, 10.0), neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in _those_with("stiffness", selection.joints(spec, self.joints)):
            in_degrees = joint.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
            joint.springref += math.degrees(self.angle) if in_degrees else self.angle


def _those_with(attribute: str, joints: list) -> list:
    """Returns the joints whose attribute is not zero; raises ValueError if it is zero for all of them."""
    chosen = [joint for joint in joints if any(getattr(joint, attribute))]
    if not chosen:
        names = ", ".join(joint.name for joint in joints)
        raise ValueError(f"no joint of {names} has a {attribute} that could be scaled")
    return chosen


def _added(joint: mujoco.MjsJoint, attribute: str, value: float, addend: float) -> float:
    """Returns the sum of value and addend; raises ValueError if it is negative."""
    if value + addend < 0.0:
        raise ValueError(f"joint '{joint.name}' has a {attribute} of {value:g}, so {-addend:g} cannot be removed")
    return value + addend
