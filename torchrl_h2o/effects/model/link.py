"""Effects on the shape of a link: its length, and the direction from its joint to the next."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.model.geom import LONG
from torchrl_h2o.effects.model.inertial import compile_unscaled
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Names

_QUATERNION = mujoco.mjtOrientation.mjORIENTATION_QUAT


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
        quaternions = compile_unscaled(spec).body_quat
        for body in bodies:
            joint = anchor(body)
            _move(spec, body, quaternions, lambda point, joint=joint: joint + self.scale * (point - joint))
            for geom in body.geoms:
                if np.isnan(geom.fromto[0]) and geom.type in LONG:
                    geom.size[1] *= self.scale


@dataclass(frozen=True)
class LinkTurn(ModelEffect):
    """Turns what is fixed to a body about the body's joint: its geoms, its sites and the joints that it carries.

    The bodies that it carries keep their orientation. With :class:`LinkLength` the end of a link can be at any place in
    the plane of its joint.

    Args:
        angle: angle about the axis of the body's first joint, in rad.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body, or one that has no hinge or gives its inertia by
            numbers, which cannot turn along.

    Examples:
        >>> LinkTurn(0.1, bodies="thigh").describe()
        'link of bodies thigh turned by 0.1 rad'
    """

    wording: ClassVar[str] = "link of {bodies} turned by {angle}"
    angle: float = parameter(unit="rad", bounds=(-math.pi, math.pi), neutral=0.0)
    bodies: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        bodies = selection.bodies(spec, self.bodies)
        if self.is_neutral:
            return
        model = compile_unscaled(spec)
        for body in bodies:
            if not body.joints or body.joints[0].type != mujoco.mjtJoint.mjJNT_HINGE or body.explicitinertial:
                raise ValueError(f"body '{body.name}' has no hinge to turn about, or an inertia given by numbers")
            joint, turn = anchor(body), np.zeros(4)
            axis = body.joints[0].axis / np.linalg.norm(body.joints[0].axis)
            mujoco.mju_axisAngle2Quat(turn, axis, self.angle)

            def turned(point: np.ndarray, joint: np.ndarray = joint, turn: np.ndarray = turn) -> np.ndarray:
                return joint + _rotated(point - joint, turn)

            _move(spec, body, model.body_quat, turned)
            for element, given in [
                *((geom, model.geom_quat[spec.geoms.index(geom)]) for geom in body.geoms),
                *((site, model.site_quat[spec.sites.index(site)]) for site in body.sites),
            ]:
                own = element.quat if element.alt.type == _QUATERNION else given
                mujoco.mju_mulQuat(element.quat, turn, np.array(own))
                element.alt.type = _QUATERNION


def _move(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, quaternions: np.ndarray, moved: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Moves the points that are fixed to a body.

    Args:
        spec: the specification of the body.
        body: edited in place.
        quaternions: of all bodies, (num_bodies, 4); the specification may have them in another form, such as angles.
        moved: returns the new place of a point, both (3,), in the body's frame.
    """
    for child in body.bodies:
        own = _rotated(anchor(child), quaternions[spec.bodies.index(child)])
        child.pos = moved(child.pos + own) - own
    for geom in body.geoms:
        if np.isnan(geom.fromto[0]):
            geom.pos = moved(geom.pos)
        else:
            geom.fromto = np.append(moved(geom.fromto[:3]), moved(geom.fromto[3:]))
    for site in body.sites:
        site.pos = moved(site.pos)
    body.ipos = moved(body.ipos)


def _rotated(vector: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.array(vector), quaternion)
    return result


def anchor(body: mujoco.MjsBody) -> np.ndarray:
    """Position of a body's first joint in the body's frame, (3,); its origin without a joint."""
    return np.array(body.joints[0].pos) if body.joints else np.zeros(3)
