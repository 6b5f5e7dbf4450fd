"""Reads and rewrites the inertial of a body: its mass, centre of mass and inertia.

A model gives the inertial explicitly or lets the compiler derive it from the body's geoms. This module reads it from a
compiled copy and writes it back as an explicit inertial, for the selected bodies only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_h2o.effects.model.compilation import compile_model


@dataclass(frozen=True)
class Inertial:
    """The mass distribution of a body, in the body's frame.

    Args:
        mass: mass in kg.
        centre: centre of mass (3,), in m.
        inertia: inertia about the centre of mass (3, 3), in kg·m².
    """

    mass: float
    centre: np.ndarray
    inertia: np.ndarray

    def with_point_mass(self, mass: float, position: np.ndarray) -> "Inertial":
        """Returns the inertial combined with a point mass in kg at a position (3,) in m."""
        total = self.mass + mass
        centre = (self.mass * self.centre + mass * position) / total
        own = self.inertia + _of_point(self.mass, self.centre - centre)
        return Inertial(total, centre, own + _of_point(mass, position - centre))


def edit_inertials(
    spec: mujoco.MjSpec, bodies: Sequence[mujoco.MjsBody], change: Callable[[Inertial], Inertial]
) -> None:
    """Rewrites the inertials of bodies, which afterwards no longer follow from their geoms.

    All other bodies keep their inertials, even in a model with a fixed total mass (``settotalmass``).

    Args:
        spec: the specification, edited in place.
        bodies: bodies of the specification.
        change: returns the new inertial of a body, given its present one.
    """
    model = compile_unscaled(spec)
    total = spec.compiler.settotalmass
    # the factor by which the compiler will multiply every mass
    scale = total / model.body_mass.sum() if total > 0.0 else 1.0
    ids = [i for i, body in enumerate(spec.bodies) if body in bodies]
    _let_given_inertials_count(spec)
    for i in ids:
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[i])
        axes = axes.reshape(3, 3)
        mass, inertia = scale * model.body_mass[i], scale * axes @ np.diag(model.body_inertia[i]) @ axes.T
        new = change(Inertial(mass, model.body_ipos[i].copy(), inertia))
        _write(spec.bodies[i], Inertial(new.mass / scale, new.centre, new.inertia / scale))
        total += new.mass - mass
    if spec.compiler.settotalmass > 0.0:
        spec.compiler.settotalmass = total


def compile_unscaled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compiles a copy of the specification without scaling the bodies to a total mass."""
    copy = spec.copy()
    copy.compiler.settotalmass = -1.0
    return compile_model(copy)


def _of_point(mass: float, offset: np.ndarray) -> np.ndarray:
    """Returns the inertia (3, 3) of a point mass about a point at an offset (parallel axis theorem)."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def _let_given_inertials_count(spec: mujoco.MjSpec) -> None:
    """Makes the compiler use explicit inertials in a model that derives all of them from geoms.

    Bodies with geoms lose an explicit inertial, because the compiler ignored it before.
    """
    if spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    low, high = spec.compiler.inertiagrouprange
    for body in spec.bodies:
        if any(low <= geom.group <= high for geom in body.geoms):
            body.explicitinertial = False  # the compiler ignored it before
            body.ipos[0] = np.nan  # the compiler's mark for a missing value


def _write(body: mujoco.MjsBody, inertial: Inertial) -> None:
    body.explicitinertial = True
    body.mass = inertial.mass
    body.ipos = inertial.centre
    moments, axes = np.linalg.eigh(inertial.inertia)
    axes[:, 2] *= np.linalg.det(axes)  # makes the axes right-handed
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.inertia = moments
    body.iquat = quaternion
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia[0] = np.nan  # the compiler accepts only one of the two
