"""Effects on the springs of joints: stiffness and rest position.

For sliding joints, N·m/rad stands for N/m and rad for m.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.model.joint import added, those_with
from torchrl_h2o.effects.parameter import ANY_SIZE, parameter
from torchrl_h2o.effects.selection import Names


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
        for joint in those_with("stiffness", selection.joints(spec, self.joints)):
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
            joint.stiffness[0] = added(joint, "stiffness", joint.stiffness[0], self.stiffness)


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
        for joint in those_with("stiffness", selection.joints(spec, self.joints)):
            in_degrees = joint.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
            joint.springref += math.degrees(self.angle) if in_degrees else self.angle
