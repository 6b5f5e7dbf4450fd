"""The effect of a simulator that weighs capsules as MuJoCo did before version 2.1.2."""

import math
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.model.inertial import Inertial, compile_unscaled, edit_inertials
from torchrl_h2o.effects.parameter import parameter


@dataclass(frozen=True)
class EarlierCapsules(ModelEffect):
    """Masses and inertias of capsules as MuJoCo computed them before version 2.1.2.

    There, a capsule weighed as a cylinder that is longer by its radius. Data of the tasks ``-v2`` and ``-v3`` of Gym,
    such as D4RL's, were recorded with it. It acts on bodies whose inertia follows from their geoms, which afterwards
    have it by numbers: effects on the shape of a capsule come before it.

    Args:
        share: 0 for the exact values, 1 for the earlier ones, linear in between.

    Raises:
        ValueError: when put into a model that has no such body with a capsule.

    Examples:
        >>> EarlierCapsules(1.0).describe()
        'capsules weighed as before MuJoCo 2.1.2, share 1'

    Source: the changelog of MuJoCo, version 2.1.2.
    """

    wording: ClassVar[str] = "capsules weighed as before MuJoCo 2.1.2, share {share}"
    share: float = parameter(unit="1", bounds=(0.0, 2.0), neutral=0.0)

    def edit(self, spec: mujoco.MjSpec) -> None:
        forced = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        low, high = spec.compiler.inertiagrouprange
        capsules = {
            i: [g for g in body.geoms if g.type == mujoco.mjtGeom.mjGEOM_CAPSULE and low <= g.group <= high]
            for i, body in enumerate(spec.bodies)
            if forced or not body.explicitinertial
        }
        capsules = {i: own for i, own in capsules.items() if own}
        if not capsules:
            raise ValueError("no body has a capsule from which its inertia follows")
        if self.is_neutral:
            return
        model, total = compile_unscaled(spec), spec.compiler.settotalmass
        new = {i: self._changed(spec, model, i, own) for i, own in capsules.items()}
        spec.compiler.settotalmass = -1.0  # the compiler scales all bodies to the total afterwards
        for i, one in new.items():
            edit_inertials(spec, [spec.bodies[i]], lambda _, one=one: one)
        spec.compiler.settotalmass = total

    def _changed(self, spec: mujoco.MjSpec, model: mujoco.MjModel, body: int, capsules: list) -> Inertial:
        """The inertial of a body in which ``share`` of each capsule is exchanged; of a model without a total mass."""
        axes = _matrix(model.body_iquat[body])
        mass, centre = model.body_mass[body], model.body_ipos[body].copy()
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T + mass * _of_point(centre)
        moment = mass * centre
        for geom in capsules:
            i = spec.geoms.index(geom)
            place, turn = model.geom_pos[i], _matrix(model.geom_quat[i])
            (exact, own), (earlier, others) = _capsule(geom, *model.geom_size[i, :2])
            more = self.share * (earlier - exact)
            mass, moment = mass + more, moment + more * place
            inertia = inertia + self.share * turn @ np.diag(others - own) @ turn.T + more * _of_point(place)
        centre = moment / mass
        return Inertial(mass, centre, inertia - mass * _of_point(centre))


def _capsule(geom: mujoco.MjsGeom, radius: float, half: float) -> list[tuple[float, np.ndarray]]:
    """Mass and moments of inertia (3), exact and as before MuJoCo 2.1.2."""
    length, area = 2.0 * half, math.pi * radius**2
    masses = [geom.density * area * (length + more * radius) for more in (4.0 / 3.0, 1.0)]
    if not np.isnan(geom.mass):
        masses = [geom.mass, geom.mass]
    ends = masses[0] * 4.0 * radius / (4.0 * radius + 3.0 * length)
    tube = masses[0] - ends
    across = tube * (3.0 * radius**2 + length**2) / 12.0
    across += ends * (0.4 * radius**2 + length**2 / 4.0 + 0.375 * radius * length)
    along = tube * radius**2 / 2.0 + 0.4 * ends * radius**2
    longer = masses[1] * (3.0 * radius**2 + (length + radius) ** 2) / 12.0
    exact, earlier = np.array([across, across, along]), np.array([longer, longer, masses[1] * radius**2 / 2.0])
    return [(masses[0], exact), (masses[1], earlier)]


def _of_point(place: np.ndarray) -> np.ndarray:
    """Inertia (3, 3) of a unit mass at a place (3,)."""
    return place @ place * np.eye(3) - np.outer(place, place)


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)
