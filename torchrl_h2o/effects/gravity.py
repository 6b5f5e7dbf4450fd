"""Effects on the pull of the ground."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects.effect import ModelEffect, parameter


@dataclass(frozen=True)
class Gravity(ModelEffect):
    """Gravity, scaled.

    Args:
        scale: factor on the model's own gravity.

    Examples:
        >>> Gravity(2.0).describe()
        'gravity × 2'

    Source: H2O+ (arXiv 2309.12716), the gap ``gravity``.
    """

    wording: ClassVar[str] = "gravity × {scale}"
    scale: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=1.0)

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.option.gravity *= self.scale
