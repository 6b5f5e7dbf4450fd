"""The effect of a link that is longer or shorter than the model's."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.model.inertial import compile_unscaled
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names

_LONG = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)


@dataclass(frozen=True)
class LinkLength(ModelEffect):
    """Scales the distance from a body's joint to the joints of the bodies that it carries.

    What is fixed to the body moves along. Capsules and cylinders become longer and keep their radius, and where the
    model derives masses from geoms, mass and inertia follow; a mass that the model gives is kept.

    Args:
        scale: factor on the length.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> LinkLength(1.1, bodies="thigh").describe()
        'link length of bodies thigh × 1.1'
    """

    wording: ClassVar[str] = "link length of {bodies} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 10.0), neutral=1.0)
    bodies: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        bodies = selection.bodies(spec, self.bodies)
        if self.is_neutral:
            return
        turns = compile_unscaled(spec).body_quat  # the specification may give them in other ways, such as Euler angles
        for body in bodies:
            joint = anchor(body)

            def scaled(point: np.ndarray, joint: np.ndarray = joint) -> np.ndarray:
                return joint + self.scale * (point - joint)

            for child in body.bodies:
                own = np.zeros(3)
                mujoco.mju_rotVecQuat(own, anchor(child), turns[spec.bodies.index(child)])
                child.pos = scaled(child.pos + own) - own
            for geom in body.geoms:
                if not np.isnan(geom.fromto[0]):
                    geom.fromto = np.append(scaled(geom.fromto[:3]), scaled(geom.fromto[3:]))
                    continue
                geom.pos = scaled(geom.pos)
                if geom.type in _LONG:
                    geom.size[1] *= self.scale
            for site in body.sites:
                site.pos = scaled(site.pos)
            body.ipos = scaled(body.ipos)


def anchor(body: mujoco.MjsBody) -> np.ndarray:
    """Position of a body's first joint in the body's frame, (3,); its origin without a joint."""
    return np.array(body.joints[0].pos) if body.joints else np.zeros(3)
