"""The inertial of a body, mass, centre of mass and inertia together, to read and to rewrite.

A model may give it, or leave it to the compiler to derive it from the body's geoms. Here it is read off
a compiled copy and written back as given, for the chosen bodies alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_h2o.effects.model.compilation import compile_model


@dataclass(frozen=True)
class Inertial:
    """How the mass of a body is distributed, in the body's frame.

    Args:
        mass: in kg.
        centre: the centre of mass (3,), in m.
        inertia: about the centre of mass (3, 3), in kg·m².
    """

    mass: float
    centre: np.ndarray
    inertia: np.ndarray

    def with_point_mass(self, mass: float, position: np.ndarray) -> "Inertial":
        """This inertial and a point mass (kg) at a position (3,), in m, as one."""
        total = self.mass + mass
        centre = (self.mass * self.centre + mass * position) / total
        own = self.inertia + _of_point(self.mass, self.centre - centre)
        return Inertial(total, centre, own + _of_point(mass, position - centre))


def edit_inertials(
    spec: mujoco.MjSpec, bodies: Sequence[mujoco.MjsBody], change: Callable[[Inertial], Inertial]
) -> None:
    """Rewrites the inertials of bodies, which no longer follow from their geoms after that.

    All other bodies keep theirs, also in a model that fixes its total mass (``settotalmass``).

    Args:
        spec: the specification, edited in place.
        bodies: bodies of the specification.
        change: from the present inertial of a body to its new one.
    """
    model = compile_unscaled(spec)
    total = spec.compiler.settotalmass
    # what the compiler will multiply every mass with
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
    """A copy of the specification, compiled before the compiler scales the bodies to a total mass."""
    copy = spec.copy()
    copy.compiler.settotalmass = -1.0
    return compile_model(copy)


def _of_point(mass: float, offset: np.ndarray) -> np.ndarray:
    """Inertia (3, 3) of a point mass about a point at an offset: the parallel axis theorem."""
    return mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))


def _let_given_inertials_count(spec: mujoco.MjSpec) -> None:
    """Has the compiler read inertials that are given, where it derived them from geoms all the same."""
    if spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    low, high = spec.compiler.inertiagrouprange
    for body in spec.bodies:
        if any(low <= geom.group <= high for geom in body.geoms):
            body.explicitinertial = False  # was given, but did not count
            body.ipos[0] = np.nan  # the compiler's sign for "not given"


def _write(body: mujoco.MjsBody, inertial: Inertial) -> None:
    body.explicitinertial = True
    body.mass = inertial.mass
    body.ipos = inertial.centre
    moments, axes = np.linalg.eigh(inertial.inertia)
    axes[:, 2] *= np.linalg.det(axes)  # a rotation, not a reflection
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.inertia = moments
    body.iquat = quaternion
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia[0] = np.nan  # the compiler takes one of the two
