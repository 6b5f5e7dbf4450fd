"""Generates the catalogue of a model: candidate effects that its simulator may lack, with trial values.

An effect is tried on single elements, on groups of elements whose names share a word, and on all elements, wherever
it changes the model. The trial values are proportional to the model's own masses, torques and control step. They are
written where their entry is defined.
"""

from collections.abc import Callable, Iterator, Sequence

import mujoco
import numpy as np

from torchrl_h2o.effects.action.play import ActionBacklash, ActionDeadBand, ActionSaturation
from torchrl_h2o.effects.action.signal import ActionBias, ActionGain, ActionNoise
from torchrl_h2o.effects.action.timing import ActionDelay, ActionLag, ActionLead
from torchrl_h2o.effects.catalogue.choices import indexed_choices
from torchrl_h2o.effects.catalogue.entry import CatalogueEntry, Trials, each, entries_of
from torchrl_h2o.effects.catalogue.mechanism import Mechanism
from torchrl_h2o.effects.catalogue.model_entries import (
    FACTORS,
    body_entries,
    force_entries,
    gear_entries,
    geom_entries,
    joint_entries,
)
from torchrl_h2o.effects.effect import ModelEffect
from torchrl_h2o.effects.force.servo import ServoDeadBand, TorqueSpeedLine
from torchrl_h2o.effects.gear.play import GearPlay
from torchrl_h2o.effects.model.capsules import EarlierCapsules
from torchrl_h2o.effects.model.compilation import compile_model, saved_model
from torchrl_h2o.effects.model.servo import ActuatorTimeConstant, ServoDamping, ServoStiffness, is_filter, is_servo
from torchrl_h2o.effects.model.world import Gravity, GravityTilt, Timestep
from torchrl_h2o.effects.observation.sensor import (
    ObservationBias,
    ObservationDelay,
    ObservationGain,
    ObservationNoise,
)
from torchrl_h2o.effects.selection import Indices


def catalogue(
    spec: mujoco.MjSpec,
    *,
    num_observations: int,
    dt: float,
    velocities: Sequence[int] = (),
) -> tuple[CatalogueEntry, ...]:
    """Returns the effects that a simulator of a model may lack, with initial values for their fits.

    Args:
        spec: the model's specification, which is not changed.
        num_observations: number of entries of the observation; 0 omits sensor effects.
        dt: the control step, in s.
        velocities: entries of the observation that are velocities. They may be late together: many machines compute
            them from positions, with a filter.

    Returns:
        The entries, all with different effects.

    Raises:
        ValueError: if the control step is not positive or the number of observations is negative.

    Examples:
        >>> pole = '''<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0"/>
        ...   <geom type="capsule" fromto="0 0 0 0 0 -1" size=".02"/></body></worldbody></mujoco>'''
        >>> entries = catalogue(mujoco.MjSpec.from_string(pole), num_observations=2, dt=0.02)
        >>> [entry.name for entry in entries][:5]
        ['Gravity', 'GravityTilt', 'Timestep', 'BodyMass pole', 'BodyInertia pole']
    """
    if not dt > 0.0:
        raise ValueError(f"the control step dt = {dt} is not positive; give the time between two actions in s")
    if num_observations < 0:
        raise ValueError(f"num_observations = {num_observations} is negative; give 0 to leave the sensors out")
    model = compile_model(spec.copy())
    mechanism = Mechanism(model)
    entries = [
        *_world_entries(mechanism),
        *body_entries(mechanism),
        *_version_entries(spec),
        *joint_entries(mechanism),
        *geom_entries(mechanism, spec),
        *force_entries(mechanism),
        *_servo_entries(mechanism, spec, dt),
        *_action_entries(mechanism, spec, dt),
        *_observation_entries(num_observations, dt, tuple(velocities)),
    ]
    unchanged = saved_model(model)
    return tuple(entry for entry in entries if _changes_something(entry, spec, unchanged))


def _world_entries(mechanism: Mechanism) -> Iterator[CatalogueEntry]:
    model = mechanism.model
    if mechanism.weight:
        yield CatalogueEntry(Gravity(), each("scale", *FACTORS))
        planar = all(mechanism.planar(body) for body in range(1, model.nbody))
        spatial = tuple({"pitch": pitch, "roll": roll} for pitch in (0.1, -0.1) for roll in (0.1, -0.1))
        yield CatalogueEntry(GravityTilt(), each("pitch", 0.1, -0.1) if planar else spatial)
    yield CatalogueEntry(Timestep(), each("scale", 0.8, 1.25))


def _servo_entries(mechanism: Mechanism, spec: mujoco.MjSpec, dt: float) -> Iterator[CatalogueEntry]:
    yield from entries_of(ServoStiffness, "actuators", _where(is_servo, spec), lambda _: each("scale", *FACTORS))
    yield from entries_of(
        ActuatorTimeConstant, "actuators", _where(is_filter, spec), lambda _: each("scale", 0.1, *FACTORS, 4.0)
    )
    servos = {
        # unlike a stiffness, what follows would act on motors, too
        own if chosen is None and len(own) < len(spec.actuators) else chosen: own
        for chosen, own in _where(lambda one: is_servo(one) and mechanism.joint_of(one.id) is not None, spec).items()
    }
    yield from entries_of(ActionLead, "actuators", servos, lambda _: each("time", 0.3 * dt, dt, 3.0 * dt))
    yield from entries_of(ServoDeadBand, "actuators", servos, lambda _: each("width", 0.005, 0.02, 0.05))
    yield from entries_of(GearPlay, "actuators", servos, lambda _: each("width", 0.005, 0.02, 0.05))

    def of_stiffness(parameter: str, *shares: float) -> Callable[[tuple[int, ...]], Trials]:
        """Shares of the torque that the servos make for an error of 1 rad."""

        def of(chosen: tuple[int, ...]) -> Trials:
            torques = [abs(spec.actuators[i].gainprm[0] * spec.actuators[i].gear[0]) for i in chosen]
            return each(parameter, *(share * float(np.median(torques)) for share in shares))

        return of

    stalls = of_stiffness("stall", 0.03, 0.1, 0.3)

    def lines(chosen: tuple[int, ...]) -> Trials:
        return tuple({**stall, "speed": speed} for stall in stalls(chosen) for speed in (2.0, 5.0, 12.0))

    yield from entries_of(TorqueSpeedLine, "actuators", servos, lines)
    # without a limit of its torque, the damping of a servo is that of its joint
    limited = {chosen: own for chosen, own in servos.items() if mechanism.model.actuator_forcelimited[list(own)].all()}
    yield from entries_of(ServoDamping, "actuators", limited, of_stiffness("damping", 0.003, 0.03))
    driven = {mechanism.joint_of(index) for own in servos.values() for index in own}
    yield from gear_entries(mechanism, sorted(joint for joint in driven if joint is not None))


def _where(applies: Callable[[mujoco.MjsActuator], bool], spec: mujoco.MjSpec) -> dict[Indices, tuple[int, ...]]:
    """The actuators of one kind: each alone, and all together."""
    chosen = tuple(index for index, actuator in enumerate(spec.actuators) if applies(actuator))
    choices: dict[Indices, tuple[int, ...]] = {(index,): (index,) for index in chosen} if len(chosen) > 1 else {}
    return choices | ({None: chosen} if chosen else {})


def _action_entries(mechanism: Mechanism, spec: mujoco.MjSpec, dt: float) -> Iterator[CatalogueEntry]:
    labels = [mechanism.actuator_label(i) for i in range(mechanism.model.nu)]

    def shares(parameter: str, *values: float) -> Callable[[tuple[int, ...]], Trials]:
        def of(actuators: tuple[int, ...]) -> Trials:
            control = float(np.median([mechanism.control(i) for i in actuators]))
            return each(parameter, *(value * control for value in values))

        return of

    def times(parameter: str, *steps: float) -> Callable[[tuple[int, ...]], Trials]:
        return lambda actuators: each(parameter, *(step * dt for step in steps))

    single_and_all = indexed_choices(labels)
    singles = {chosen: indices for chosen, indices in single_and_all.items() if len(indices) == 1}
    yield from entries_of(
        ActionGain,
        "actuators",
        indexed_choices(labels, groups=True),
        lambda _: each("scale", *FACTORS),
    )
    yield from entries_of(ActionBias, "actuators", singles, shares("bias", 0.1, -0.1))
    # of a position servo, these are ServoDeadBand and GearPlay
    servos = {index for index, actuator in enumerate(spec.actuators) if is_servo(actuator)}
    of_motors = {chosen: own for chosen, own in single_and_all.items() if not servos & set(own)}
    yield from entries_of(ActionDeadBand, "actuators", of_motors, shares("width", 0.03, 0.15))
    yield from entries_of(ActionSaturation, "actuators", single_and_all, shares("limit", 0.4, 0.8))
    yield from entries_of(ActionBacklash, "actuators", of_motors, shares("width", 0.1, 0.4))
    yield from entries_of(ActionLag, "actuators", single_and_all, times("time_constant", 0.3, 1.0, 2.0))
    yield from entries_of(ActionDelay, "actuators", single_and_all, times("delay", 0.3, 1.0, 2.0, 3.0))
    yield from entries_of(ActionNoise, "actuators", indexed_choices(labels, singles=False), shares("std", 0.1, 0.5))


def _observation_entries(num: int, dt: float, velocities: tuple[int, ...]) -> Iterator[CatalogueEntry]:
    together = indexed_choices([""] * num, singles=False)
    late = together | ({velocities: velocities} if 0 < len(velocities) < num else {})
    single = {chosen: entries for chosen, entries in indexed_choices([""] * num).items() if len(entries) == 1}
    yield from entries_of(ObservationGain, "entries", single, lambda _: each("scale", 0.8, 1.25))
    yield from entries_of(ObservationBias, "entries", single, lambda _: each("bias", 0.1, -0.1))
    yield from entries_of(ObservationDelay, "entries", late, lambda _: each("delay", 0.3 * dt, dt, 2.0 * dt))
    yield from entries_of(ObservationNoise, "entries", together, lambda _: each("std", 0.01, 0.1))


def _version_entries(spec: mujoco.MjSpec) -> Iterator[CatalogueEntry]:
    """Yields what an earlier version of MuJoCo computed otherwise, if all inertias of a model follow from its geoms.

    That is so in Gym's tasks, whose data may be of an earlier version, and not in the model of a machine.
    """
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        yield CatalogueEntry(EarlierCapsules(), each("share", 0.5, 1.0))


def _changes_something(entry: CatalogueEntry, spec: mujoco.MjSpec, unchanged: bytes) -> bool:
    """Whether the first trial of a model effect compiles to a different model; True for other effects."""
    first = entry.starts[0]
    if not isinstance(first, ModelEffect):
        return True
    try:
        return saved_model(compile_model(spec.copy(), [first])) != unchanged
    except ValueError:
        return False
