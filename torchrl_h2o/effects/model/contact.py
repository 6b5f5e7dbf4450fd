"""Effects on contacts: softness and rolling resistance."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class ContactSoftness(ModelEffect):
    """Scales the time constant of contacts (``solref``).

    The damping ratio stays the same. A contact uses the mean of its two geoms. MuJoCo does not accept time constants
    below two physics steps, so contacts that are already that hard cannot become harder.

    Args:
        scale: factor on the time constant.
        geoms: name patterns of the geoms.

    Raises:
        ValueError: when put into a model that has no such geom.

    Examples:
        >>> ContactSoftness(2.0, geoms="*foot*").describe()
        'time constant of contacts of geoms *foot* × 2'
    """

    wording: ClassVar[str] = "time constant of contacts of {geoms} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.1, 10.0), neutral=1.0)
    geoms: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for geom in selection.geoms(spec, self.geoms):
            if geom.solref[0] > 0.0:
                geom.solref[0] *= self.scale
            else:  # -stiffness and -damping, which scale with 1/time² and 1/time
                geom.solref[0] /= self.scale**2
                geom.solref[1] /= self.scale


@dataclass(frozen=True)
class RollingResistance(ModelEffect):
    """Rolling resistance, as of a soft wheel or a carpet: a torque of ``coefficient`` · load.

    The geoms' contacts use MuJoCo's rolling friction (``condim`` 6). This also activates the geoms' torsional friction,
    unless it was active before.

    Args:
        coefficient: addition to the rolling friction, in m; the model's own value counts only if it was active.
        geoms: name patterns of the geoms.

    Raises:
        ValueError: when put into a model that has no such geom.

    Examples:
        >>> RollingResistance(0.002, geoms="*wheel*").describe()
        'rolling resistance of geoms *wheel* + 0.002 m'
    """

    wording: ClassVar[str] = "rolling resistance of {geoms} + {coefficient}"
    coefficient: float = parameter(unit="m", bounds=(0.0, 1.0), neutral=0.0)
    geoms: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for geom in selection.geoms(spec, self.geoms):
            if self.coefficient and geom.condim < 6:
                geom.condim = 6
                geom.friction[2] = 0.0  # the model's value was inactive with this condim
            geom.friction[2] += self.coefficient
