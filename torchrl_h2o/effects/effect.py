"""Base classes of effects: named physical causes by which two dynamics differ.

An effect is a frozen dataclass whose parameters have a unit, bounds and a neutral value. It acts on one of five
things: the model, numbers of the model that depend on the state, the actions, the forces or the observations.
"""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects.joint_units import motion, unit_under
from torchrl_h2o.effects.parameter import Parameter
from torchrl_h2o.effects.selection import Indices, Names, checked_indices, checked_names
from torchrl_h2o.effects.states import BatchedForce, States, Variation

# by a field's type, which is a string in modules with ``from __future__ import annotations``
_SELECTIONS = {Names: checked_names, "Names": checked_names, Indices: checked_indices, "Indices": checked_indices}

EntryNames = Mapping[str, Sequence[str]]
NO_NAMES: EntryNames = MappingProxyType({})
Process = Callable[[np.ndarray], np.ndarray]
Force = Callable[[mujoco.MjData], np.ndarray]


@dataclass(frozen=True)
class Effect(ABC):
    """Base of all effects. Subclass one of the five kinds below, not this class.

    A subclass is a frozen dataclass. Fields made by :func:`parameter` are its parameters; all other fields select what
    it acts on, by name patterns (``Names``) or indices (``Indices``). The class attribute ``wording`` describes the
    effect, with the fields' names in braces, and ``{load}`` for "torque" or "force". ``random`` marks effects that draw
    from the generator that :meth:`process` receives. ``of_signal`` names the parameter that has the unit of the
    actions or observations that the effect acts on, if there is one. ``amounts`` names the parameters without which the
    others, such as the place of a payload, change nothing; by default, all.

    Raises:
        ValueError: for a parameter that is not a number within its bounds, or a field of type ``Names`` or
            ``Indices`` with an invalid selection.

    Examples:
        >>> from torchrl_h2o.effects import Gravity
        >>> Gravity(2.0).parameters
        {'scale': Parameter(value=2.0, unit='1', bounds=(0.0, 10.0), neutral=1.0)}
        >>> Gravity(2.0).describe(), Gravity().is_neutral
        ('gravity × 2', True)
        >>> Gravity(-1.0)
        Traceback (most recent call last):
        ...
        ValueError: Gravity: scale = -1 lies outside its bounds [0, 10]; choose a value within them
    """

    wording: ClassVar[str]
    random: ClassVar[bool] = False
    of_signal: ClassVar[str | None] = None
    amounts: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if "unit" in field.metadata:
                value = self._checked(field.name, value, *field.metadata["bounds"])
            elif field.type in _SELECTIONS:
                value = self._selected(field, value)
            elif isinstance(value, Iterable) and not isinstance(value, str):
                value = tuple(value)  # a list, as from a configuration file, would make the effect unhashable
            object.__setattr__(self, field.name, value)

    def _checked(self, name: str, value: float, low: float, high: float) -> float:
        try:
            value = float(value)
        except (TypeError, ValueError):
            raise ValueError(
                f"{type(self).__name__}: {name} = {value!r} is not a number; choose one in [{low:g}, {high:g}]"
            ) from None
        if not low <= value <= high:  # this form also rejects NaN
            raise ValueError(
                f"{type(self).__name__}: {name} = {value:g} lies outside its bounds "
                f"[{low:g}, {high:g}]; choose a value within them"
            )
        return value

    def _selected(self, field: dataclasses.Field, value: Any) -> Names | Indices:
        try:
            return _SELECTIONS[field.type](value)
        except ValueError as error:
            raise ValueError(f"{type(self).__name__}: {field.name} = {error}") from None

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters by name, in the order of the fields."""
        return {
            field.name: Parameter(getattr(self, field.name), **field.metadata)
            for field in dataclasses.fields(self)
            if "unit" in field.metadata
        }

    def parameters_on(self, names: EntryNames) -> dict[str, Parameter]:
        """The parameters by name, with the units of the joints, actions or observations that the effect acts on.

        Args:
            names: the joints of the model and the units, as for :meth:`describe`.

        Examples:
            >>> from torchrl_h2o.effects import ActionSaturation, JointDamping
            >>> joints = {"joints": ["rail"], "joint_bodies": ["cart"], "joint_types": ["slide"]}
            >>> str(JointDamping(0.1, "rail").parameters_on(joints)["damping"])
            '0.1 N·s/m'
            >>> str(ActionSaturation(3.8).parameters_on({"actuator_units": ["V"]})["limit"])
            '3.8 V'
        """
        moving = motion(getattr(self, "joints", None), names)
        return {
            name: dataclasses.replace(
                parameter,
                unit=self._unit_of_signal(names) if name == self.of_signal else unit_under(moving, parameter.unit),
            )
            for name, parameter in self.parameters.items()
        }

    def _unit_of_signal(self, names: EntryNames) -> str:
        """The unit of the actions or observations that the effect acts on; "1" if not known, or if they differ."""
        for chosen, of in (("actuators", "actuator_units"), ("entries", "entry_units")):
            if hasattr(self, chosen):
                units, indices = names.get(of, ()), getattr(self, chosen)
                found = {units[i] for i in (range(len(units)) if indices is None else indices) if i < len(units)}
                return found.pop() if len(found) == 1 else "1"
        return "1"

    @property
    def is_neutral(self) -> bool:
        """Whether its amounts, or all parameters, have their neutral values, so that the effect changes nothing."""
        parameters = self.parameters
        return all(parameters[name].value == parameters[name].neutral for name in self.amounts or parameters)

    def with_parameters(self, values: Mapping[str, float]) -> "Effect":
        """Returns the effect with other values for some or all of its parameters, by name.

        Raises:
            ValueError: if a value is not a number within the parameter's bounds.
        """
        return dataclasses.replace(self, **values)

    def describe(self, names: EntryNames = NO_NAMES) -> str:
        """Describes the effect in words with units.

        Args:
            names: names for the entries that are selected by index, by field (``"actuators"``, ``"entries"``), their
                units (``"actuator_units"``, ``"entry_units"``), and the joints of the model, from
                :func:`~torchrl_h2o.effects.joint_names`. Without the joints, units are those of hinges.

        Examples:
            >>> from torchrl_h2o.effects import ActionGain
            >>> ActionGain(0.7, (0, 1)).describe(), ActionGain(0.7, (0, 1)).describe({"actuators": ["hip", "knee"]})
            ('actuators 0, 1 × 0.7', 'actuators hip, knee × 0.7')
        """
        parameters = self.parameters_on(names)
        chosen = {
            field.name: _in_words(field.name, getattr(self, field.name), names.get(field.name, ()))
            for field in dataclasses.fields(self)
            if field.name not in parameters
        }
        load = motion(getattr(self, "joints", None), names).value
        return self.wording.format(**parameters, **chosen, load=load)


def _in_words(field: str, chosen: Any, names: Sequence[str]) -> str:
    """Words for a selection: "all joints" for ``"*"``; "actuators 0, 2" for ``(0, 2)``, or their names."""
    if chosen is None or chosen == "*":
        return f"all {field}"
    selected = chosen if isinstance(chosen, tuple) else (chosen,)
    return f"{field} {', '.join(names[int(i)] if i in range(len(names)) else str(i) for i in selected)}"


def checked_effects(effects: Iterable[Any]) -> tuple[Effect, ...]:
    """Returns effects as a tuple; raises TypeError for anything else, such as the name of an effect."""
    found: tuple[Any, ...] = tuple(effects) if isinstance(effects, Iterable) else (effects,)
    for effect in (effects,) if isinstance(effects, str) else found:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"expected effects such as Gravity(2.0), got {effect!r}; for one of the paper's gaps by name, use "
                "paper_gap or dynamics_gap"
            )
    return found


class ModelEffect(Effect):
    """An effect on the model: masses, geometry, joints, contacts, gravity."""

    @abstractmethod
    def edit(self, spec: mujoco.MjSpec) -> None:
        """Edits the model's specification in place.

        Args:
            spec: the specification, as parsed from the model's own file. It is compiled after the last edit, so that
                masses and inertias follow from the geometry.

        Raises:
            ValueError: if the model has no element that the effect could act on.
        """


class ActionEffect(Effect):
    """An effect on the actions: how the executed action differs from the commanded one.

    ``memoryless`` marks effects whose executed action depends only on the action commanded in the same step. Their
    process accepts many steps at once.
    """

    memoryless: ClassVar[bool] = False

    @abstractmethod
    def process(self, dt: float, rng: np.random.Generator) -> Process:
        """Returns the function that alters the actions of one episode.

        Args:
            dt: the control step, in seconds.
            rng: the episode's random generator, shared by its random effects.

        Returns:
            A function from the commanded to the executed action, both (..., nu), called once per control step. The
            function holds the state of the episode, because the effect itself is frozen.
        """

    def run(self, actions: np.ndarray, dt: float, rng: np.random.Generator) -> np.ndarray:
        """Alters the actions of one whole run, with the same result as :meth:`process` step by step.

        Args:
            actions: the commanded actions (T, nu), from the start of the run.
            dt: the control step, in seconds.
            rng: the run's random generator.

        Returns:
            The executed actions (T, nu), a new array.
        """
        process = self.process(dt, rng)
        if self.memoryless:
            return process(actions)
        return np.array([process(action) for action in actions]).reshape(actions.shape)


class ForceEffect(Effect):
    """An effect that is a generalised force, a function of state, action and time.

    The force is evaluated anew at every physics step, so a simulator that steps many states at once must advance by
    one physics step at a time.
    """

    @abstractmethod
    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Force:
        """Returns the force of one episode as a function of the state.

        Args:
            model: the model in use; names are resolved once, in this call.
            rng: the episode's random generator, shared by its random effects.

        Returns:
            A function from the state before a physics step to the force in N or torque in N·m on every degree of
            freedom, (nv,). It reads ``qpos``, ``qvel``, ``ctrl`` and ``time``, and the bodies' positions and
            velocities, which are up to date; it must not write to them. The caller must not write to the result. The
            function holds the state of the episode, because the effect itself is frozen.

        Raises:
            ValueError: if the model has no element that the effect could act on.
        """

    def batched(self, model: mujoco.MjModel, rng: np.random.Generator | None = None) -> BatchedForce:
        """Returns the force as a function of many states, for an effect without memory.

        Args:
            model: the model in use.
            rng: the random generator of a random effect.

        Returns:
            A function from B states to the generalised forces (B, nv). The caller must not write to the result.

        Raises:
            ValueError: if the model has no element that the effect could act on.
        """
        force, data = self.process(model, rng or np.random.default_rng()), mujoco.MjData(model)

        def forces(states: States) -> np.ndarray:
            together = np.empty((len(states.qpos), model.nv))
            for i, one in enumerate(zip(*states, strict=True)):
                data.qpos, data.qvel, data.act, data.ctrl, data.time = one
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_comVel(model, data)
                together[i] = force(data)
            return together

        return forces


class VaryingEffect(Effect):
    """An effect on numbers of the model that depend on the state, such as friction that grows with the load of a gear.

    They are computed anew before every physics step, each effect after those before it in the list, and those of
    ``acts_last`` after all others. MuJoCo's solver then lets a joint stick and slip.
    """

    acts_last: ClassVar[bool] = False

    @abstractmethod
    def vary(self, model: mujoco.MjModel, weight: BatchedForce) -> Variation:
        """Returns the variation for many states at once.

        It may have a memory: it knows from the states' time whether they follow those of the last call.

        Args:
            model: the model in use; names are resolved once, in this call.
            weight: torques of the weight on the degrees of freedom, which all effects on a model share.

        Raises:
            ValueError: if the model has no element that the effect could act on.
        """


class ObservationEffect(Effect):
    """An effect on the observations: how the reported observation differs from the true one.

    ``memoryless`` marks effects whose reported observation depends only on the true one at the same time. Their
    process accepts any number of observations at once, (..., n).
    """

    memoryless: ClassVar[bool] = False

    @abstractmethod
    def process(self, dt: float, rng: np.random.Generator) -> Process:
        """Returns the function that alters the observations of one episode.

        Args:
            dt: the control step, in seconds.
            rng: the episode's random generator, shared by its random effects.

        Returns:
            A function from the true to the reported observation, both (..., n), called at the reset and after every
            control step.
        """

    def restore(self, observations: np.ndarray, dt: float) -> np.ndarray:
        """Estimates the true observations from the reported ones of one whole run.

        Args:
            observations: the reported observations (T, n), from the start of the run.
            dt: the control step, in seconds.

        Returns:
            The observations without the effect (T, n), a new array, with NaN where they are unknown. The default
            returns the reported observations.
        """
        return np.array(observations, dtype=float)
