"""Effects on joints: range, and what resists their motion.

Numbers for sliding joints have the sliding unit: N for N·m, kg for kg·m².
"""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class JointRange(ModelEffect):
    """Both ends of the range of joints, scaled.

    Args:
        scale: factor on the ends of the range.
        joints: name patterns of the joints; those without a range are passed over.

    Raises:
        ValueError: when put into a model that has no such joint, or none of them with a range.

    Examples:
        >>> JointRange(0.5, joints="*thigh*").describe()
        'range of joints *thigh* × 0.5'

    Source: H2O+ (arXiv 2309.12716), the gaps ``broken_thigh`` and ``flexible_thigh``.
    """

    wording: ClassVar[str] = "range of {joints} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 10.0), neutral=1.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in those_with("range", selection.joints(spec, self.joints)):
            joint.range *= self.scale


@dataclass(frozen=True)
class JointDamping(ModelEffect):
    """Viscous friction in joints, a torque against the velocity and proportional to it.

    Args:
        damping: added to the joints' own damping, in N·m·s/rad; below zero it takes away.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or less damping than is taken.

    Examples:
        >>> JointDamping(0.1, joints="*wheel*").describe()
        'damping of joints *wheel* + 0.1 N·m·s/rad'
    """

    wording: ClassVar[str] = "damping of {joints} + {damping}"
    damping: float = parameter(unit="N·m·s/rad", bounds=(-100.0, 100.0), neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            # the entries after the first are the coefficients of higher powers of the velocity
            joint.damping[0] = added(joint, "damping", joint.damping[0], self.damping)


@dataclass(frozen=True)
class JointFrictionLoss(ModelEffect):
    """Dry (Coulomb) friction in joints, a torque against the velocity whatever its size.

    Args:
        torque: added to the joints' own ``frictionloss``, in N·m; below zero it takes away.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or less friction than is taken.

    Examples:
        >>> JointFrictionLoss(0.2, joints="*wheel*").describe()
        'dry friction of joints *wheel* + 0.2 N·m'
    """

    wording: ClassVar[str] = "dry friction of {joints} + {torque}"
    torque: float = parameter(unit="N·m", bounds=(-100.0, 100.0), neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            joint.frictionloss = added(joint, "frictionloss", joint.frictionloss, self.torque)


@dataclass(frozen=True)
class Armature(ModelEffect):
    """Inertia of the rotors that drive joints, seen at the joint.

    Args:
        inertia: added to the joints' own ``armature``, in kg·m²; below zero it takes away.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or less armature than is taken.

    Examples:
        >>> Armature(0.05, joints="*wheel*").describe()
        'armature of joints *wheel* + 0.05 kg·m²'
    """

    wording: ClassVar[str] = "armature of {joints} + {inertia}"
    inertia: float = parameter(unit="kg·m²", bounds=(-100.0, 100.0), neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            joint.armature = added(joint, "armature", joint.armature, self.inertia)


def those_with(attribute: str, joints: list) -> list:
    """Of the joints, those whose attribute is not zero, which no factor could change."""
    chosen = [joint for joint in joints if any(getattr(joint, attribute))]
    if not chosen:
        names = ", ".join(joint.name for joint in joints)
        raise ValueError(f"no joint of {names} has a {attribute} that could be scaled")
    return chosen


def added(joint: mujoco.MjsJoint, attribute: str, value: float, addend: float) -> float:
    """The sum; raises ValueError where more is taken away than there is."""
    if value + addend < 0.0:
        raise ValueError(f"joint '{joint.name}' has a {attribute} of {value:g}, {-addend:g} cannot be taken away")
    return value + addend
