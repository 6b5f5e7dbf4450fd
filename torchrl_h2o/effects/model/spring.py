"""Effects on the springs of joints: how stiff they are and where they rest.

Numbers for sliding joints have the sliding unit: N/m for N·m/rad, m for rad.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.model.joint import added, those_with
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class JointStiffness(ModelEffect):
    """The springs of joints, scaled.

    Args:
        scale: factor on the stiffness.
        joints: name patterns of the joints; those without a spring are passed over.

    Raises:
        ValueError: when put into a model that has no such joint, or none of them with a spring.

    Examples:
        >>> JointStiffness(0.0, joints="*foot*").describe()
        'stiffness of joints *foot* × 0'

    Source: H2O+ (arXiv 2309.12716), the gap ``soft_feet``.
    """

    wording: ClassVar[str] = "stiffness of {joints} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=1.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in those_with("stiffness", selection.joints(spec, self.joints)):
            joint.stiffness *= self.scale


@dataclass(frozen=True)
class JointSpring(ModelEffect):
    """A spring on joints, as of a cable or a hose: a torque proportional to the way from rest.

    It pulls towards the rest position that the joint has (``springref``), zero unless the model says.

    Args:
        stiffness: added to the joints' own stiffness, in N·m/rad; below zero it takes away.
        joints: name patterns of the joints.

    Raises:
        ValueError: when put into a model that has no such joint, or less stiffness than is taken.

    Examples:
        >>> JointSpring(0.5, joints="*hip*").describe()
        'stiffness of joints *hip* + 0.5 N·m/rad'
    """

    wording: ClassVar[str] = "stiffness of {joints} + {stiffness}"
    stiffness: float = parameter(unit="N·m/rad", bounds=(-10000.0, 10000.0), neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in selection.joints(spec, self.joints):
            # the entries after the first are the coefficients of higher powers of the angle
            joint.stiffness[0] = added(joint, "stiffness", joint.stiffness[0], self.stiffness)


@dataclass(frozen=True)
class JointRest(ModelEffect):
    """The rest position of the springs of joints, shifted.

    Args:
        angle: added to the joints' ``springref``, in rad.
        joints: name patterns of the joints; those without a spring are passed over.

    Raises:
        ValueError: when put into a model that has no such joint, or none of them with a spring.

    Examples:
        >>> JointRest(0.1, joints="*foot*").describe()
        'rest of joints *foot* + 0.1 rad'
    """

    wording: ClassVar[str] = "rest of {joints} + {angle}"
    angle: float = parameter(unit="rad", bounds=(-10.0, 10.0), neutral=0.0)
    joints: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for joint in those_with("stiffness", selection.joints(spec, self.joints)):
            in_degrees = joint.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
            joint.springref += math.degrees(self.angle) if in_degrees else self.angle
