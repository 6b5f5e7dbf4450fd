"""Effect on the physics timestep."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import parameter


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
