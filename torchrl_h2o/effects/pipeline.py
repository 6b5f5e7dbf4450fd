"""Applies a list of effects: to a model, to actions, to observations, and as forces.

:meth:`Pipeline.begin` serves simulators that are stepped one control step at a time; the methods on whole runs serve
recorded data, where all steps are known at once.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple, TypeGuard, TypeVar, cast

import mujoco
import numpy as np

from torchrl_h2o.effects.action.timing import ActionDelay
from torchrl_h2o.effects.effect import (
    ActionEffect,
    Effect,
    Force,
    ForceEffect,
    ObservationEffect,
    Process,
    VaryingEffect,
    checked_effects,
)
from torchrl_h2o.effects.gear.loads import Weight
from torchrl_h2o.effects.model.compilation import compile_model, edit_spec
from torchrl_h2o.effects.noise_balance import balanced
from torchrl_h2o.effects.observation.sensor import ObservationDelay
from torchrl_h2o.effects.states import BatchedForce, Variation

Kind = TypeVar("Kind", bound=Effect)
Key = TypeVar("Key", bound=Hashable)


class Episode(NamedTuple):
    """The action, observation and force effects of one episode, with their state since its start.

    Args:
        actions: functions from an action (..., nu) to the altered one, in order.
        observations: functions from an observation (..., n) to the altered one, in order.
        forces: functions from the simulation's state to generalised forces (nv,), which are summed.
        variations: numbers of the model that depend on the state, in the order in which they are applied.
    """

    actions: Sequence[Process] = ()
    observations: Sequence[Process] = ()
    forces: Sequence[Force] = ()
    variations: Sequence[Variation] = ()

    def executed(self, action: np.ndarray) -> np.ndarray:
        """Returns the action that the simulator executes, (..., nu), as a new array of floats."""
        return _apply(self.actions, action)

    def observed(self, observation: np.ndarray) -> np.ndarray:
        """Returns the observation that the sensors report, (..., n), as a new array of floats."""
        return _apply(self.observations, observation)


@dataclass(frozen=True)
class Pipeline:
    """A list of effects and how it is applied.

    Effects compose in their order: model edits first to last before one compilation, action effects first to last,
    observation effects first to last, forces summed. Neutral effects are skipped. Negative noise is subtracted
    from the noise before it, see :func:`~torchrl_h2o.effects.balanced`. If it exceeds that noise, ValueError
    is raised when actions are altered, not when the pipeline is made.

    Args:
        effects: the effects, in their order.

    Examples:
        >>> import numpy as np
        >>> from torchrl_h2o.effects import ActionBias, ActionGain, Pipeline
        >>> pipeline = Pipeline((ActionGain(2.0), ActionBias(0.5)))
        >>> pipeline.begin(dt=0.05).executed(np.ones(2))
        array([2.5, 2.5])
        >>> pipeline.executed_run(np.ones((3, 1)), dt=0.05).ravel()
        array([2.5, 2.5, 2.5])
    """

    effects: tuple[Effect, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "effects", checked_effects(self.effects))

    @classmethod
    def balanced_together(cls, groups: Mapping[Key, Sequence[Effect]]) -> dict[Key, Pipeline]:
        """Returns one pipeline per group of effects, with negative noise subtracted across all groups in their order.

        Args:
            groups: lists of effects by any key, the one nearest to the simulator first.

        Raises:
            ValueError: if negative noise exceeds the noise before it.
        """
        settled = iter(balanced([effect for effects in groups.values() for effect in effects]))
        return {key: cls(tuple(islice(settled, len(effects)))) for key, effects in groups.items()}

    @cached_property
    def settled(self) -> tuple[Effect, ...]:
        """The effects with negative noise subtracted; raises ValueError if it exceeds the noise before it."""
        return balanced(self.effects)

    @property
    def is_random(self) -> bool:
        """Whether an episode draws random numbers."""
        return any(effect.random and not effect.is_neutral for effect in self.settled)

    def of_kind(self, kind: type[Kind]) -> list[Kind]:
        """Returns the effects of a class that are not neutral, with negative noise subtracted."""
        only_actions = issubclass(cast("type[Effect]", kind), ActionEffect)  # the cast keeps the type of ``kind``
        effects = self.settled if only_actions else self.effects  # only action noise can be negative
        return [effect for effect in effects if isinstance(effect, kind) and not effect.is_neutral]

    # ---------------------------------------------------------------------------------------------- model
    def edit(self, spec: mujoco.MjSpec) -> None:
        """Edits a specification in place with the model effects; see :func:`edit_spec`."""
        edit_spec(spec, self.effects)

    def compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """Edits a specification in place and compiles it; see :func:`~torchrl_h2o.effects.compile_model`."""
        return compile_model(spec, self.effects)

    def batched_forces(self, model: mujoco.MjModel) -> list[BatchedForce]:
        """Returns the forces as functions of many states; see :meth:`ForceEffect.batched`."""
        return [effect.batched(model) for effect in self.of_kind(ForceEffect)]

    def variations(self, model: mujoco.MjModel) -> list[Variation]:
        """Returns how numbers of the model depend on the state, in the order in which they are applied."""
        effects = sorted(self.of_kind(VaryingEffect), key=lambda one: one.acts_last)
        if not effects:
            return []
        weight = Weight(model).torques
        return [effect.vary(model, weight) for effect in effects]

    # ---------------------------------------------------------------------------------------- step by step
    def begin(self, dt: float, rng: np.random.Generator | None = None, model: mujoco.MjModel | None = None) -> Episode:
        """Begins an episode.

        Args:
            dt: the control step, in s.
            rng: the generator of the random effects; not needed if there are none.
            model: the compiled model. Without it the episode holds no forces and no variations.

        Raises:
            ValueError: if the model has no element that a force or a variation could act on; also during the episode,
                if an effect draws random numbers although its class is not marked ``random``.
        """

        def processes(kind: type[ActionEffect | ForceEffect | ObservationEffect], on: Any) -> list:
            return [effect.process(on, _generator_for(effect, rng)) for effect in self.of_kind(kind)]

        # effects share the generator, so this order decides which numbers they draw at the start of an episode
        observations = processes(ObservationEffect, dt)
        actions = processes(ActionEffect, dt)
        if model is None:
            return Episode(actions, observations)
        return Episode(actions, observations, processes(ForceEffect, model), self.variations(model))

    # ------------------------------------------------------------------------------------------ whole runs
    def executed_run(self, actions: np.ndarray, dt: float, rng: np.random.Generator | None = None) -> np.ndarray:
        """Returns the actions that the simulator executes in one recorded run.

        A delay of the whole observation is applied to the actions instead, which gives the same run, shifted in time.

        Args:
            actions: the recorded actions, (T, nu), from the start of the run.
            dt: the control step, in s.
            rng: the generator of the random effects, which are skipped without it.

        Returns:
            The executed actions, (T, nu).
        """
        for effect in self.settled:
            if effect.is_neutral or (effect.random and rng is None):
                continue
            if isinstance(effect, ActionEffect):
                actions = effect.run(actions, dt, _generator_for(effect, rng))
            elif _delays_all(effect):
                actions = ActionDelay(effect.delay).run(actions, dt, _generator_for(effect, rng))
        return actions

    def restore_run(self, observations: np.ndarray, dt: float) -> np.ndarray:
        """Undoes the observation effects in one recorded run, except a delay of the whole observation.

        Args:
            observations: the reported observations, (T, n), from the start of the run.
            dt: the control step, in s.

        Returns:
            The observations before the effects, (T, n); NaN where they cannot be restored.
        """
        return self._restored(observations, dt, ObservationEffect)

    def undelay_run(self, observations: np.ndarray, dt: float) -> np.ndarray:
        """Undoes the delays of single entries of the observation in one recorded run; see :meth:`restore_run`."""
        return self._restored(observations, dt, ObservationDelay)

    def observe_memoryless(self, observations: np.ndarray, dt: float) -> np.ndarray:
        """Applies the observation effects that are neither random nor depend on earlier observations.

        Args:
            observations: the observations before the effects, (..., n).
            dt: the control step, in s.

        Returns:
            The reported observations, (..., n).
        """
        for effect in self.effects:
            if (
                isinstance(effect, ObservationEffect)
                and effect.memoryless
                and not effect.is_neutral
                and not effect.random
            ):
                observations = effect.process(dt, _generator_for(effect, None))(observations)
        return observations

    def _restored(self, observations: np.ndarray, dt: float, kind: type[ObservationEffect]) -> np.ndarray:
        for effect in reversed(self.effects):
            if isinstance(effect, kind) and not effect.is_neutral and not _delays_all(effect):
                observations = effect.restore(observations, dt)
        return observations


class _NoGenerator:
    """Replaces the generator for effects that are not marked ``random``: any use raises ValueError."""

    def __init__(self, effect: Effect):
        self.effect = effect

    def __getattr__(self, name: str) -> Any:
        raise ValueError(
            f"{self.effect} draws random numbers, but its class is not marked random: write "
            f"'random: ClassVar[bool] = True' into the class {type(self.effect).__name__}"
        )


def _generator_for(effect: Effect, rng: np.random.Generator | None) -> Any:
    return rng if effect.random else _NoGenerator(effect)


def _delays_all(effect: Effect) -> TypeGuard[ObservationDelay]:
    return isinstance(effect, ObservationDelay) and effect.entries is None


def _apply(processes: Sequence[Process], values: np.ndarray) -> np.ndarray:
    values = values.astype(float)  # a copy, because an effect may keep the array it is given
    for process in processes:
        values = process(values)
    return values
