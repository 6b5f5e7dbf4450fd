"""Effects on bodies: how heavy they are."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect, compile_model, parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class BodyMass(ModelEffect):
    """Mass and inertia of bodies, scaled together: the same shape of another density.

    The other bodies keep their masses, also in a model that fixes its total (``settotalmass``).

    Args:
        scale: factor on mass and inertia.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> BodyMass(1.2, bodies="torso").describe()
        'mass of bodies torso × 1.2'
    """

    wording: ClassVar[str] = "mass of {bodies} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 100.0), neutral=1.0)
    bodies: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        before = _total_mass(spec)
        for body in selection.bodies(spec, self.bodies):
            # Given explicitly or derived from the geoms: the compiler reads one of the two.
            body.mass *= self.scale
            body.inertia *= self.scale
            body.fullinertia *= self.scale
            for geom in body.geoms:
                geom.density *= self.scale
                geom.mass *= self.scale
        if spec.compiler.settotalmass > 0.0:
            # The compiler scales all bodies to the total, so that has to change with the chosen.
            spec.compiler.settotalmass *= _total_mass(spec) / before


def _total_mass(spec: mujoco.MjSpec) -> float:
    """The mass of all bodies before the compiler scales them to a total."""
    copy = spec.copy()
    copy.compiler.settotalmass = -1.0
    return compile_model(copy).body_mass.sum()
