"""Catalogue entries for the bodies, joints and geoms of a model, and for forces on them.

The trial values are proportional to the inertias and torques at the joints and to the masses of the bodies.
"""

from collections.abc import Callable, Collection, Iterator, Sequence

import mujoco
import numpy as np

from torchrl_h2o.effects.catalogue.choices import named_choices
from torchrl_h2o.effects.catalogue.entry import CatalogueEntry, Trials, each, entries_of
from torchrl_h2o.effects.catalogue.mechanism import Mechanism
from torchrl_h2o.effects.force.drag import JointForce, LinearDrag, QuadraticDrag
from torchrl_h2o.effects.gear.friction import LoadFriction, StribeckFriction
from torchrl_h2o.effects.model.body import BodyCentreOfMass, BodyInertia, BodyMass, Payload
from torchrl_h2o.effects.model.compilation import compile_model
from torchrl_h2o.effects.model.geom import ContactSoftness, GeomFriction, GeomLength, GeomSize, RollingResistance
from torchrl_h2o.effects.model.joint import (
    LOCKED,
    Armature,
    JointDamping,
    JointFrictionLoss,
    JointRange,
    JointRest,
    JointSpring,
    JointStiffness,
)
from torchrl_h2o.effects.model.link import LinkLength
from torchrl_h2o.effects.selection import Names

# scales that a trial multiplies a property of the model by
FACTORS = (0.5, 0.8, 1.25, 2.0)
LENGTHS = (0.05, 0.4, 0.8)  # the same of a link
# relative change of a body's inertia above which a geom contributes to it
_INERTIA_CHANGE = 1e-9

Choices = dict[Names, tuple[int, ...]]


def body_entries(mechanism: Mechanism) -> Iterator[CatalogueEntry]:
    """Yields entries for mass, inertia, centre of mass and payload of the bodies that have a mass, and for links."""
    model = mechanism.model
    heavy = [b for b in range(1, model.nbody) if model.body_weldid[b] and model.body_mass[b] > mujoco.mjMINVAL]
    paths = _body_paths(model)
    # indices that skip the world, as the name patterns of bodies do
    eligible, massless = [b - 1 for b in heavy], set(range(model.nbody - 1)) - {b - 1 for b in heavy}
    yield from _factors(mechanism, BodyMass, "bodies", named_choices(paths, eligible, passed_over=massless))
    singles = named_choices(paths, eligible, groups=False)
    yield from _factors(mechanism, BodyInertia, "bodies", singles)
    yield from entries_of(BodyCentreOfMass, "bodies", singles, lambda chosen: _shifts(mechanism, chosen[0] + 1))
    # a payload sits on a trunk or at the end of a limb, behind which only frames without mass may follow
    alone = set(np.flatnonzero(model.body_subtreemass == model.body_mass))
    carrying = {
        name: (index,)
        for name, (index,) in singles.items()
        if model.body_parentid[index + 1] == 0 or index + 1 in alone
    }
    yield from entries_of(Payload, "bodies", carrying, lambda chosen: _loads(mechanism, chosen[0] + 1))
    links = named_choices(paths, [b - 1 for b in range(1, model.nbody) if mechanism.is_link(b)])
    yield from entries_of(LinkLength, "bodies", links, lambda _: each("scale", *LENGTHS))


def joint_entries(mechanism: Mechanism) -> Iterator[CatalogueEntry]:
    """Yields entries for range, springs, damping, friction and armature of the joints, except floating roots."""
    model = mechanism.model
    bearings = [j for j in mechanism.single_joints if not mechanism.floating(j)]
    limited = [j for j in bearings if model.jnt_limited[j]]
    sprung = [j for j in bearings if model.jnt_stiffness[j] > 0.0]
    loose = [j for j in bearings if model.jnt_stiffness[j] == 0.0]

    def chosen(joints: Sequence[int], passed_over: Collection[int] = (), groups: bool = True) -> Choices:
        return named_choices(_joint_paths(model), joints, passed_over=passed_over, groups=groups)

    everything = set(range(model.njnt))
    ranges = each("scale", *FACTORS, LOCKED)
    yield from entries_of(JointRange, "joints", chosen(limited, everything - set(limited)), lambda _: ranges)
    yield from _factors(mechanism, JointStiffness, "joints", chosen(sprung, everything - set(sprung)))
    yield from entries_of(JointRest, "joints", chosen(sprung, groups=False), lambda _: each("angle", 0.1, -0.1))
    yield from entries_of(JointSpring, "joints", chosen(loose), _added(mechanism.torque, "stiffness", (0.1, 1.0)))
    dampings = _added(lambda j: mechanism.inertia(j) / 0.1, "damping", (0.1, 1.0), _own(model, "dof_damping"))
    yield from entries_of(JointDamping, "joints", chosen(bearings), dampings)
    frictions = _added(mechanism.torque, "torque", (0.01, 0.1), _own(model, "dof_frictionloss"))
    yield from entries_of(JointFrictionLoss, "joints", chosen(bearings), frictions)
    inertias = _added(mechanism.inertia, "inertia", (0.1, 1.0), _own(model, "dof_armature"))
    yield from entries_of(Armature, "joints", chosen(bearings), inertias)


def gear_entries(mechanism: Mechanism, joints: Sequence[int]) -> Iterator[CatalogueEntry]:
    """Yields entries for the friction of the gears of joints that servos drive."""
    chosen = named_choices(_joint_paths(mechanism.model), joints)
    yield from entries_of(LoadFriction, "joints", chosen, lambda _: each("share", 0.05, 0.2))

    def at_rest(own: tuple[int, ...]) -> Trials:
        torque = 0.1 * float(np.median([mechanism.torque(joint) for joint in own]))
        amounts = ({"torque": torque, "share": 0.0}, {"torque": 0.0, "share": 0.1})
        return tuple(amount | {"speed": speed} for amount in amounts for speed in (0.2, 2.0))

    yield from entries_of(StribeckFriction, "joints", chosen, at_rest)


def geom_entries(mechanism: Mechanism, spec: mujoco.MjSpec) -> Iterator[CatalogueEntry]:
    """Yields entries for size, length, friction, softness and rolling of the geoms that have mass or contacts."""
    model, pairs = mechanism.model, mechanism.touching()
    everything, touching = set(range(model.ngeom)), sorted({geom for pair in pairs for geom in pair})
    moving = [g for g in everything if model.body_weldid[model.geom_bodyid[g]]]
    planes = {g for g in everything if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE}
    weighing = _weighing(mechanism, spec, [g for g in moving if g not in touching])

    def chosen(geoms: Collection[int], passed_over: Collection[int] = (), groups: bool = True) -> Choices:
        return named_choices(_geom_paths(model), sorted(geoms), passed_over=passed_over, groups=groups)

    shaped = [g for g in moving if g in touching or g in weighing]
    hidden = everything - set(touching) - weighing
    yield from _factors(mechanism, GeomSize, "geoms", chosen(shaped, hidden | planes))
    spanned = {geom.name for geom in spec.geoms if not np.isnan(geom.fromto[0])}
    lengthy = {g for g in shaped if model.geom(g).name in spanned}
    yield from _factors(mechanism, GeomLength, "geoms", chosen(lengthy, everything - lengthy))
    rubbing = chosen(touching, everything - set(touching))
    own = {names: geoms for names, geoms in rubbing.items() if len(geoms) != 1 or geoms[0] in moving}
    yield from entries_of(
        GeomFriction,
        "geoms",
        own,
        lambda geoms: each("scale", *(factor for factor in FACTORS if _rubs_otherwise(model, pairs, geoms, factor))),
    )
    together = {names: geoms for names, geoms in rubbing.items() if len(geoms) > 1}
    yield from _factors(mechanism, ContactSoftness, "geoms", together)
    rolling = [g for g in touching if mechanism.wheel(g)]
    yield from entries_of(
        RollingResistance,
        "geoms",
        chosen(rolling),
        lambda geoms: each("coefficient", *(share * float(model.geom_size[geoms[0], 0]) for share in (0.01, 0.1))),
    )


def force_entries(mechanism: Mechanism) -> Iterator[CatalogueEntry]:
    """Yields entries for constant forces on joints, and for drag on root bodies and on all bodies."""
    model = mechanism.model
    pushed = [j for j in mechanism.single_joints if mechanism.slides(j) or not mechanism.floating(j)]
    forces = _signed(mechanism.torque, "torque", 0.05)
    yield from entries_of(JointForce, "joints", named_choices(_joint_paths(model), pushed, groups=False), forces)
    roots = [b - 1 for b in range(1, model.nbody) if model.body_weldid[b] == b and model.body_parentid[b] == 0]
    dragged = named_choices(_body_paths(model), roots, groups=False)
    if list(dragged.values()) != [tuple(range(model.nbody - 1))]:
        dragged["*"] = tuple(range(model.nbody - 1))
    for drag in (LinearDrag, QuadraticDrag):
        yield from entries_of(
            drag,
            "bodies",
            dragged,
            lambda bodies: each("coefficient", *(rate * mechanism.mass / len(bodies) for rate in (0.1, 1.0))),
        )


def _factors(mechanism: Mechanism, effect: type, field: str, choices: Choices) -> Iterator[CatalogueEntry]:
    return entries_of(effect, field, choices, lambda _: each("scale", *FACTORS))


def _shifts(mechanism: Mechanism, body: int) -> Trials:
    """Returns shifts of the centre of mass in both directions of every axis that has an effect."""
    far, axes = 0.5 * mechanism.radius_of_gyration(body), mechanism.axes(body)
    return tuple({**dict.fromkeys(axes, 0.0), axis: sign * far} for axis in axes for sign in (1.0, -1.0))


def _loads(mechanism: Mechanism, body: int) -> Trials:
    """Returns a light and a heavy payload at the centre of mass."""
    model = mechanism.model
    centre = dict(zip("xyz", model.body_ipos[body], strict=True))
    place = {axis: centre[axis] for axis in mechanism.axes(body)}
    return tuple({"mass": share * model.body_mass[body], **place} for share in (0.1, 0.5))


def _added(
    size: Callable[[int], float], parameter: str, shares: Sequence[float], own: Callable[[int], float] | None = None
) -> Callable[[tuple[int, ...]], Trials]:
    """Returns trials that add shares of the joints' median size, and a trial that halves the smallest present value.

    Args:
        size: returns the size for a joint, in units of the parameter.
        parameter: the name of the parameter.
        shares: shares of the median size.
        own: returns the joint's present value; without it nothing is removed.
    """

    def trials(joints: tuple[int, ...]) -> Trials:
        typical = float(np.median([size(j) for j in joints]))
        least = min(own(j) for j in joints) if own else 0.0
        taken = (-0.5 * least,) if least > 0.0 else ()
        return each(parameter, *(share * typical for share in shares), *taken)

    return trials


def _signed(size: Callable[[int], float], parameter: str, share: float) -> Callable[[tuple[int, ...]], Trials]:
    return lambda joints: each(parameter, *(sign * share * size(joints[0]) for sign in (1.0, -1.0)))


def _own(model: mujoco.MjModel, field: str) -> Callable[[int], float]:
    return lambda joint: float(np.ravel(getattr(model, field)[model.jnt_dofadr[joint]])[0])


def _weighing(mechanism: Mechanism, spec: mujoco.MjSpec, geoms: Sequence[int]) -> set[int]:
    """Returns the geoms whose size changes the inertia of a body."""
    model, found = mechanism.model, set()
    for geom in geoms:
        if not model.geom(geom).name:
            continue
        larger = compile_model(spec.copy(), [GeomSize(1.5, geoms=model.geom(geom).name)])
        if not np.allclose(larger.body_inertia, model.body_inertia, rtol=_INERTIA_CHANGE, atol=0.0):
            found.add(geom)
    return found


def _rubs_otherwise(
    model: mujoco.MjModel, pairs: Sequence[tuple[int, int]], geoms: Sequence[int], factor: float
) -> bool:
    """Whether scaling the friction of geoms changes a contact; a contact uses the larger friction of its two geoms."""
    before = model.geom_friction[:, 0]
    after = before.copy()
    after[list(geoms)] *= factor
    priority = model.geom_priority
    for a, b in pairs:
        counting = [a, b] if priority[a] == priority[b] else [max(a, b, key=lambda g: priority[g])]
        if before[counting].max() != after[counting].max():
            return True
    return False


def _body_paths(model: mujoco.MjModel) -> list[tuple[str, str]]:
    bodies = [model.body(b) for b in range(1, model.nbody)]
    return [(model.body(body.parentid[0]).name, body.name) for body in bodies]


def _joint_paths(model: mujoco.MjModel) -> list[tuple[str, str]]:
    return [(model.body(model.jnt_bodyid[j]).name, model.joint(j).name) for j in range(model.njnt)]


def _geom_paths(model: mujoco.MjModel) -> list[tuple[str, str]]:
    return [(model.body(model.geom_bodyid[g]).name, model.geom(g).name) for g in range(model.ngeom)]
