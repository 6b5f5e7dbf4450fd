"""Effects on the whole simulation: magnitude and direction of gravity, physics timestep."""

from dataclasses import dataclass
from math import cos, pi, sin
from typing import ClassVar

import mujoco

from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import parameter


@dataclass(frozen=True)
class Gravity(ModelEffect):
    """Scales gravity.

    Args:
        scale: factor on the model's own gravity.

    Examples:
        >>> Gravity(2.0).describe()
        'gravity × 2'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gap ``gravity``.
    """

    wording: ClassVar[str] = "gravity × {scale}"
    scale: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=1.0)

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.gravity *= self.scale


@dataclass(frozen=True)
class GravityTilt(ModelEffect):
    """Tilts gravity, which models a sloping floor in a simulator whose floor is level.

    Gravity is rotated about the world's x axis by ``roll``, then about its y axis by ``pitch``. A floor that rises
    towards +x by some angle corresponds to a pitch of that angle.

    Args:
        pitch: angle about the world's y axis, in rad.
        roll: angle about the world's x axis, in rad.

    Examples:
        >>> GravityTilt(pitch=0.05).describe()
        'gravity tilted by 0.05 rad in pitch, 0 rad in roll'
        >>> from torchrl_h2o.effects import compile_model
        >>> compile_model(mujoco.MjSpec(), [GravityTilt(pitch=0.1)]).opt.gravity.round(3)
        array([-0.979,  0.   , -9.761])
    """

    wording: ClassVar[str] = "gravity tilted by {pitch} in pitch, {roll} in roll"
    pitch: float = parameter(unit="rad", bounds=(-pi, pi), neutral=0.0)
    roll: float = parameter(unit="rad", bounds=(-pi, pi), neutral=0.0)

    def edit(self, spec: mujoco.MjSpec) -> None:
        if self.is_neutral:  # a rotation by zero would still change -0.0 to 0.0
            return
        x, y, z = spec.option.gravity
        y, z = cos(self.roll) * y - sin(self.roll) * z, sin(self.roll) * y + cos(self.roll) * z
        x, z = cos(self.pitch) * x + sin(self.pitch) * z, cos(self.pitch) * z - sin(self.pitch) * x
        spec.option.gravity = [x, y, z]


@dataclass(frozen=True)
class Timestep(ModelEffect):
    """Scales the physics timestep, so that the system runs faster or slower than nominal.

    The number of physics steps per control step stays the same, so a control step covers ``scale`` times the time.

    Args:
        scale: factor on the model's timestep.

    Examples:
        >>> Timestep(1.1).describe()
        'timestep × 1.1'
    """

    wording: ClassVar[str] = "timestep × {scale}"
    scale: float = parameter(unit="1", bounds=(0.1, 10.0), neutral=1.0)

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.timestep *= self.scale
