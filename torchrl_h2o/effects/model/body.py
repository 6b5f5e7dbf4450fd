"""Effects on bodies: mass, inertia, centre of mass and payload."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import selection
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.model.inertial import Inertial, compile_unscaled, edit_inertials
from torchrl_h2o.effects.parameter import ANY_AMOUNT, parameter
from torchrl_h2o.effects.selection import Names


@dataclass(frozen=True)
class BodyMass(ModelEffect):
    """Scales the mass and inertia of bodies together, as a change of density does.

    The other bodies keep their masses, even in a model with a fixed total mass (``settotalmass``).

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
        before = compile_unscaled(spec).body_mass.sum()
        for body in selection.bodies(spec, self.bodies):
            # the compiler reads either the explicit values or those of the geoms, so both are scaled
            body.mass *= self.scale
            body.inertia *= self.scale
            body.fullinertia *= self.scale
            for geom in body.geoms:
                geom.density *= self.scale
                geom.mass *= self.scale
        if spec.compiler.settotalmass > 0.0:
            # the compiler scales all bodies to this total, so it has to change with the selected bodies
            spec.compiler.settotalmass *= compile_unscaled(spec).body_mass.sum() / before


class _OnInertials(ModelEffect):
    """An effect on the inertials of bodies, which afterwards no longer follow from their geoms."""

    bodies: Names

    def edit(self, spec: mujoco.MjSpec) -> None:
        bodies = selection.bodies(spec, self.bodies)
        if not self.is_neutral:
            edit_inertials(spec, bodies, self._changed)

    @abstractmethod
    def _changed(self, body: Inertial) -> Inertial:
        """The inertial with the effect."""


@dataclass(frozen=True)
class BodyInertia(_OnInertials):
    """Scales the rotational inertia of bodies at constant mass.

    Afterwards the bodies' masses and inertias no longer follow from their geoms, so effects on geoms must come first.

    Args:
        scale: factor on the inertia about the centre of mass.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> BodyInertia(0.8, bodies="torso").describe()
        'inertia of bodies torso × 0.8'
    """

    wording: ClassVar[str] = "inertia of {bodies} × {scale}"
    scale: float = parameter(unit="1", bounds=(0.01, 100.0), neutral=1.0)
    bodies: Names = "*"

    def _changed(self, body: Inertial) -> Inertial:
        return replace(body, inertia=self.scale * body.inertia)


@dataclass(frozen=True)
class BodyCentreOfMass(_OnInertials):
    """Shifts the centre of mass of bodies; mass and inertia about the centre stay the same.

    Afterwards the bodies' masses and inertias no longer follow from their geoms, so effects on geoms must come first.

    Args:
        x: shift along the x axis of the body's frame, in m.
        z: shift along the z axis of the body's frame, in m.
        y: shift along the y axis of the body's frame, in m.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> BodyCentreOfMass(x=0.01, bodies="torso").describe()
        'centre of mass of bodies torso shifted by x 0.01 m, y 0 m, z 0 m'
    """

    wording: ClassVar[str] = "centre of mass of {bodies} shifted by x {x}, y {y}, z {z}"
    x: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    z: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    y: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    bodies: Names = "*"

    def _changed(self, body: Inertial) -> Inertial:
        return replace(body, centre=body.centre + np.array([self.x, self.y, self.z]))


@dataclass(frozen=True)
class Payload(ModelEffect):
    """A point mass fixed to bodies, such as a battery or a camera.

    Afterwards the bodies' masses and inertias no longer follow from their geoms, so effects on geoms must come first.
    The position has no effect while the mass is zero.

    Args:
        mass: mass of the payload on each body, in kg.
        x: x coordinate in the body's frame, in m.
        z: z coordinate in the body's frame, in m.
        y: y coordinate in the body's frame, in m.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> Payload(1.5, z=0.1, bodies="torso").describe()
        'payload of 1.5 kg at x 0 m, y 0 m, z 0.1 m on bodies torso'
    """

    amounts: ClassVar[tuple[str, ...]] = ("mass",)
    wording: ClassVar[str] = "payload of {mass} at x {x}, y {y}, z {z} on {bodies}"
    mass: float = parameter(unit="kg", bounds=ANY_AMOUNT, neutral=0.0)
    x: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    z: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    y: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    bodies: Names = "*"

    def edit(self, spec: mujoco.MjSpec) -> None:
        bodies = selection.bodies(spec, self.bodies)
        if self.mass:
            edit_inertials(spec, bodies, self._loaded)

    def _loaded(self, body: Inertial) -> Inertial:
        return body.with_point_mass(self.mass, np.array([self.x, self.y, self.z]))


@dataclass(frozen=True)
class PseudoInertia(_OnInertials):
    r"""Changes the ten inertial parameters of bodies in a way that stays physically possible.

    The mass distribution is deformed: a point at :math:`p` from the centre of mass moves to :math:`A p + t`, with
    :math:`A = \begin{pmatrix} e^{d_1} & s_{12} & s_{13} \\ 0 & e^{d_2} & s_{23} \\ 0 & 0 & e^{d_3} \end{pmatrix}`, and
    every mass is multiplied by :math:`e^{2 \alpha}`. Any values give a mass and an inertia that a body can have.

    Afterwards the bodies' masses and inertias no longer follow from their geoms, so effects on geoms must come first.

    Args:
        alpha: half the logarithm of the factor on the mass.
        d1: logarithm of the stretch along the x axis of the body's frame.
        d2: the same along the y axis.
        d3: the same along the z axis.
        s12: shear of x with y.
        s13: shear of x with z.
        s23: shear of y with z.
        t1: shift of the centre of mass along the x axis, in m.
        t2: the same along the y axis.
        t3: the same along the z axis.
        bodies: name patterns of the bodies.

    Raises:
        ValueError: when put into a model that has no such body.

    Examples:
        >>> PseudoInertia(alpha=0.1, t1=0.01, bodies="torso").describe()
        'pseudo-inertia of bodies torso: alpha 0.1, d 0, 0, 0, s 0, 0, 0, t 0.01 m, 0 m, 0 m'

    Source: C. Rucker, P. M. Wensing, *Smooth Parameterization of Rigid-Body Inertia*, IEEE Robotics and Automation
    Letters 7 (2022), the log-Cholesky parameters of :math:`U` in :math:`J' = U J U^T`.
    """

    wording: ClassVar[str] = (
        "pseudo-inertia of {bodies}: alpha {alpha}, d {d1}, {d2}, {d3}, s {s12}, {s13}, {s23}, t {t1}, {t2}, {t3}"
    )
    alpha: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    d1: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    d2: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    d3: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    s12: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    s13: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    s23: float = parameter(unit="1", bounds=(-2.0, 2.0), neutral=0.0)
    t1: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    t2: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    t3: float = parameter(unit="m", bounds=(-10.0, 10.0), neutral=0.0)
    bodies: Names = "*"

    def _changed(self, body: Inertial) -> Inertial:
        stretch = np.diag(np.exp([self.d1, self.d2, self.d3]))
        stretch[np.triu_indices(3, 1)] = self.s12, self.s13, self.s23
        density = np.exp(2.0 * self.alpha)
        moments = 0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia  # second moments of the mass
        moments = density * stretch @ moments @ stretch.T
        centre = body.centre + np.array([self.t1, self.t2, self.t3])
        return Inertial(density * body.mass, centre, np.trace(moments) * np.eye(3) - moments)
