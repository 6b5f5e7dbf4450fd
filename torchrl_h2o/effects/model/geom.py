"""Effects on geoms: size, length, friction, softness of contacts and rolling resistance."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names

LONG = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)  # their second size is half their length


@dataclass(frozen=True)
class GeomFriction(ModelEffect):
    """Scales all three friction coefficients (sliding, torsional, rolling) of geoms.

    A contact uses the larger coefficient of its two geoms, so scaling only one of them may change nothing.

    Args:
        scale: factor on the coefficients.
        geoms: name patterns of the geoms.

    Raises:
        ValueError: when put into a model that has no such geom.

    Examples:
        >>> GeomFriction(0.3).describe()
        'friction of all geoms × 0.3'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gap ``friction``.
    """

    wording: ClassVar[str] = "friction of {geoms} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=1.0)
    geoms: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for geom in selection.geoms(spec, self.geoms):
            geom.friction *= self.scale


@dataclass(frozen=True)
class GeomSize(ModelEffect):
    """Scales all entries of the size of geoms, such as the radius and half length of a capsule.

    The size of a geom that is given by its two ends (``fromto``) does not include its length; see :class:`GeomLength`.
    Masses and inertias change with the size where the model derives them from its geoms.

    Args:
        scale: factor on the sizes.
        geoms: name patterns of the geoms.

    Raises:
        ValueError: when put into a model that has no such geom.

    Examples:
        >>> GeomSize(2.0, geoms="*thigh*").describe()
        'size of geoms *thigh* × 2'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gaps ``big_thigh`` and ``small_thigh``.
    """

    wording: ClassVar[str] = "size of {geoms} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 10.0), neutral=1.0)
    geoms: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        for geom in selection.geoms(spec, self.geoms):
            geom.size *= self.scale


@dataclass(frozen=True)
class GeomLength(ModelEffect):
    """Scales the two ends (``fromto``) of geoms about the origin of their body.

    Args:
        scale: factor on the coordinates of both ends.
        geoms: name patterns of the geoms.

    Raises:
        ValueError: when put into a model that has no such geom, or that defines it by position and size.

    Examples:
        >>> GeomLength(4.0, geoms="torso").describe()
        'length of geoms torso × 4'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gap ``long_torso``.
    """

    wording: ClassVar[str] = "length of {geoms} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 10.0), neutral=1.0)
    geoms: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        chosen = selection.geoms(spec, self.geoms)
        spanned = [geom for geom in chosen if not np.isnan(geom.fromto[0])]
        if not spanned:
            names = ", ".join(geom.name for geom in chosen)
            raise ValueError(f"no geom of {names} is given by its two ends (fromto); use GeomSize")
        for geom in spanned:
            geom.fromto *= self.scale


@dataclass(frozen=True)
class CapsuleLength(ModelEffect):
    """Scales the length of capsules and cylinders about their centre, without the caps; the radius stays.

    Args:
        scale: factor on the length.
        geoms: name patterns of the geoms; geoms of other shapes are skipped.

    Raises:
        ValueError: when put into a model that has no such capsule or cylinder.

    Examples:
        >>> CapsuleLength(0.5, geoms="foot").describe()
        'capsule length of geoms foot × 0.5'
    """

    wording: ClassVar[str] = "capsule length of {geoms} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 10.0), neutral=1.0)
    geoms: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        named = selection.geoms(spec, self.geoms)
        chosen = [geom for geom in named if geom.type in LONG]
        if not chosen:
            raise ValueError(f"no geom of {', '.join(geom.name for geom in named)} is a capsule or a cylinder")
        for geom in () if self.is_neutral else chosen:
            if np.isnan(geom.fromto[0]):
                geom.size[1] *= self.scale
            else:
                centre = (geom.fromto[:3] + geom.fromto[3:]) / 2.0
                half = self.scale * (geom.fromto[3:] - centre)
                geom.fromto = np.append(centre - half, centre + half)


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
