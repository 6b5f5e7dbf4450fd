"""Effects on what geoms do when they touch: how softly they give way, how hard they roll."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class ContactSoftness(ModelEffect):
    """How slowly contacts push geoms apart: the time constant of their ``solref``, scaled.

    The damping ratio stays. A contact takes the mean of its two geoms. MuJoCo refuses time constants
    below two physics steps, so that a hard contact may not get harder.

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
            else:  # minus stiffness and minus damping, which go with 1/time² and 1/time
                geom.solref[0] /= self.scale**2
                geom.solref[1] /= self.scale


@dataclass(frozen=True)
class RollingResistance(ModelEffect):
    """Resistance to rolling, as of a soft wheel or a carpet: a torque of ``coefficient`` · load.

    The geoms' contacts get the rolling friction of MuJoCo (``condim`` 6). Where they had none, the
    torsional friction that the geom names begins to act as well.

    Args:
        coefficient: added to the rolling friction that acts already, in m.
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
                geom.friction[2] = 0.0  # stood in the model but did not act
            geom.friction[2] += self.coefficient
