"""A generalised force given as a sum of terms in text form, as found in measured data."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects.effect import NO_NAMES, EntryNames, Force, ForceEffect
from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.effects.parameter import Parameter
from torchrl_h2o.effects.states import BatchedForce, States

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class DegreeOfFreedom:
    """A degree of freedom of a model.

    Args:
        name: the joint's name, with the axis appended for a free or ball joint.
        velocity: its index in ``qvel``.
        position: its index in ``qpos``; None for rotations in space.
        sliding: whether it is a translation in m rather than a rotation in rad.
    """

    name: str
    velocity: int
    position: int | None
    sliding: bool


@dataclass(frozen=True)
class ResidualForce(ForceEffect):
    """A generalised force that is a sum of terms in position, velocity, action and time.

    Every term is a string such as ``"torque on elbow: 0.41 · sin(7 q)"``; see
    :class:`~torchrl_h2o.effects.force.term.ForceTerm`. The parameters are the terms' coefficients (neutral value zero)
    and the frequencies, phases and start times in them, numbered by term: ``coefficient_2``, ``frequency_2``.

    Args:
        terms: the terms.

    Raises:
        ValueError: for a string that is not a term; when put into a model without the joint, control or coordinate.

    Examples:
        >>> ripple = ResidualForce(("torque on elbow: 0.41 · sin(7 q)",))
        >>> ripple.describe()
        'torque on joint elbow: 0.41 N·m · sin(7 q)'
        >>> ripple.with_parameters({"frequency_1": 6.0}).terms
        ('torque on elbow: 0.41 · sin(6 q)',)
    """

    wording: ClassVar[str] = "{terms}"
    terms: tuple[str, ...] = ()

    def __post_init__(self):
        if isinstance(self.terms, str):
            object.__setattr__(self, "terms", (self.terms,))
        super().__post_init__()
        object.__setattr__(self, "terms", tuple(str(ForceTerm.parse(term)) for term in self.terms))

    @cached_property
    def parsed(self) -> tuple[ForceTerm, ...]:
        """The terms, parsed."""
        return tuple(ForceTerm.parse(term) for term in self.terms)

    @property
    def parameters(self) -> dict[str, Parameter]:
        return {
            f"{name}_{i}": value
            for i, term in enumerate(self.parsed, start=1)
            for name, value in term.parameters().items()
        }

    @property
    def is_neutral(self) -> bool:
        return all(term.coefficient == 0.0 for term in self.parsed)

    def with_parameters(self, values: Mapping[str, float]) -> "ResidualForce":
        unknown = [name for name in values if name not in self.parameters]
        if unknown:
            raise ValueError(f"{self.describe()} has no parameter {unknown[0]!r}; it has {', '.join(self.parameters)}")
        terms = [
            term.with_parameters({n: float(values[f"{n}_{i}"]) for n in term.parameters() if f"{n}_{i}" in values})
            for i, term in enumerate(self.parsed, start=1)
        ]
        return ResidualForce(tuple(map(str, terms)))

    def describe(self, names: EntryNames = NO_NAMES) -> str:
        return "; ".join(term.words() for term in self.parsed) or "no force"

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        forces = self.batched(model, rng)
        return lambda data: forces(States.of(data))[0]

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        known = {freedom.name: freedom for freedom in degrees_of_freedom(model)}
        for term in self.parsed:
            _require(term, known, model)

        def forces(states: States) -> np.ndarray:
            qpos, qvel, _, ctrl, time = states
            total = np.zeros_like(qvel)
            for term in self.parsed:
                freedom = known[term.joint]
                shape = term.shape(lambda name, of=freedom: coordinate(name, of, qpos, qvel, ctrl, time))
                total[:, freedom.velocity] += term.coefficient * shape
            return total

        return forces


def degrees_of_freedom(model: mujoco.MjModel) -> list[DegreeOfFreedom]:
    """Returns the degrees of freedom of a model, in the model's order.

    Examples:
        >>> free = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><freejoint name='root'/><geom size='1'/></body></worldbody></mujoco>"
        ... )
        >>> [freedom.name for freedom in degrees_of_freedom(free)][2:4]
        ['root_z', 'root_roll']
    """
    found = []
    for i in range(model.njnt):
        name, kind = model.joint(i).name or f"joint_{i}", mujoco.mjtJoint(model.jnt_type[i])
        place, rate = int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])
        if kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            found.append(DegreeOfFreedom(name, rate, place, kind == mujoco.mjtJoint.mjJNT_SLIDE))
            continue
        axes = _AXES if kind == mujoco.mjtJoint.mjJNT_FREE else _AXES[3:]
        for k, axis in enumerate(axes):
            sliding = axis in "xyz"
            found.append(DegreeOfFreedom(f"{name}_{axis}", rate + k, place + k if sliding else None, sliding))
    return found


def coordinate(
    name: str, freedom: DegreeOfFreedom, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """Returns the values (...) of a coordinate of a term.

    Args:
        name: ``q``, ``v``, ``t`` or ``a0``, ``a1``, ...
        freedom: the degree of freedom that the force acts on.
        qpos: positions, (..., nq).
        qvel: velocities, (..., nv).
        ctrl: controls, (..., nu).
        time: time in s, (...).
    """
    if name == "q":
        return qpos[..., freedom.position]
    if name == "v":
        return qvel[..., freedom.velocity]
    return time if name == "t" else ctrl[..., int(name[1:])]


def _require(term: ForceTerm, known: Mapping[str, DegreeOfFreedom], model: mujoco.MjModel) -> None:
    freedom = known.get(term.joint)
    if freedom is None:
        raise ValueError(f"this model has no joint named '{term.joint}'; it has {', '.join(known)}")
    if freedom.sliding != term.sliding:
        kinds = ("torque", "force") if term.sliding else ("force", "torque")
        raise ValueError(f"joint '{term.joint}' takes a {kinds[0]}, not a {kinds[1]}: write '{kinds[0]} on ...'")
    for factor in term.factors:
        if factor.coordinate == "q" and freedom.position is None:
            raise ValueError(f"joint '{term.joint}' has no position q that is a single number; use its velocity v")
        if factor.coordinate.startswith("a") and int(factor.coordinate[1:]) >= model.nu:
            raise ValueError(f"{factor} refers to a control that this model lacks; it has {model.nu}, counted from 0")
