"""A simulator as tracing sees it: a model that effects can be put into, stepped from many states at once.

Everything runs through ``mujoco.rollout``; one control step is ``frame_skip`` physics steps under one action.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import cpu_count
from pathlib import Path

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from torchrl.envs import EnvBase

from torchrl_h2o.effects import (
    ActionDelay,
    ActionEffect,
    CatalogueEntry,
    Effect,
    ForceEffect,
    ModelEffect,
    ObservationDelay,
    ObservationEffect,
    balanced,
    catalogue,
    compile_model,
)
from torchrl_h2o.envs.physics import FULL_PHYSICS, roll_out
from torchrl_h2o.residuals.simulation.state_map import StateMap

_CHUNK = 2**24  # numbers that a rollout may return at once: 128 MB


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulator, its control step, what is observed of it, and the effects that are in it.

    Args:
        spec: returns the model's specification, parsed anew.
        frame_skip: physics steps a control step.
        state_map: how observations and states belong together.
        effects: those in it, in their order.
        name: what to call it in reports.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.effects import Gravity
        >>> from torchrl_h2o.residuals import Simulation
        >>> simulation = Simulation.from_env(GymEnv("HalfCheetah-v5"))
        >>> simulation.with_effects(Gravity(2.0)).model.opt.gravity[2]
        np.float64(-19.62)
    """

    spec: Callable[[], mujoco.MjSpec]
    frame_skip: int
    state_map: StateMap
    effects: tuple[Effect, ...] = ()
    name: str = "simulator"
    _pool: Rollout = field(default_factory=lambda: Rollout(nthread=cpu_count()), repr=False)

    @classmethod
    def from_env(cls, env: EnvBase) -> Simulation:
        """The simulation inside a TorchRL env of a Gymnasium MuJoCo task, with the env's gaps.

        Raises:
            ValueError: if the env does not run on MuJoCo or its observation is not linear in the state.
        """
        from torchrl_h2o.residuals.simulation.from_env import simulation_of

        return simulation_of(env)

    @classmethod
    def from_mjcf(
        cls,
        path: str | Path,
        state_map: StateMap | Sequence[str] | Mapping[str, str],
        control_step: float,
        effects: Sequence[Effect] = (),
    ) -> Simulation:
        """An MJCF file.

        Args:
            path: of the file.
            state_map: a map, or the names of what is observed, in the order of the data: a joint's name for its
                position, with ``_velocity`` behind it for its velocity; or which of these each column of a log is.
            control_step: the time between two rows of the data, in s: a multiple of the model's timestep.
            effects: put into it.

        Raises:
            ValueError: for names that the model does not have, or a control step that is no multiple.
        """
        from torchrl_h2o.residuals.simulation.from_mjcf import simulation_of

        return simulation_of(Path(path), state_map, control_step, tuple(effects), cls)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model with the model effects in it."""
        return compile_model(self.spec(), self.effects)

    @property
    def control_step(self) -> float:
        """The time between two actions, in s."""
        return self.frame_skip * self.model.opt.timestep

    @property
    def actuators(self) -> tuple[str, ...]:
        """The names of the action's entries, their indices where they have none."""
        return tuple(self.model.actuator(i).name or str(i) for i in range(self.model.nu))

    @cached_property
    def _data(self) -> list[mujoco.MjData]:
        return [mujoco.MjData(self.model) for _ in range(max(1, self._pool.nthread))]

    def catalogue(self) -> tuple[CatalogueEntry, ...]:
        """The effects that the simulator, with the effects that are in it, could lack."""
        spec = self.spec()
        for effect in self.effects:
            if isinstance(effect, ModelEffect):
                effect.edit(spec)
        return catalogue(spec, num_observations=len(self.state_map.names), dt=self.control_step)

    def with_effects(self, *effects: Effect) -> Simulation:
        """The simulation with more effects in it, behind those that are in it."""
        more = replace(self, effects=(*self.effects, *effects))
        if not any(isinstance(effect, ModelEffect) for effect in effects):
            # the same model: not compiled anew for every value of an actuator's delay
            more.__dict__.update(model=self.model, _data=self._data)
        return more

    def executed(self, actions: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """What is executed of the actions of one recorded run, (T, nu), after the action effects.

        Random effects are left out without a generator. Sensors that are all late by the same time show a run as it
        would be if its actions were late, and are taken so.
        """
        for effect in balanced(self.effects):
            if effect.is_neutral or (effect.random and rng is None):
                continue
            if isinstance(effect, ActionEffect):
                actions = effect.run(actions, self.control_step, rng)
            elif _all_late(effect):
                actions = ActionDelay(effect.delay).run(actions, self.control_step, rng)
        return actions

    def true_observations(self, observations: np.ndarray) -> np.ndarray:
        """What the sensors of one run, (T, n), saw before the observation effects; NaN where that cannot be told."""
        for effect in reversed(self.effects):
            if isinstance(effect, ObservationEffect) and not effect.is_neutral and not _all_late(effect):
                observations = effect.restore(observations, self.control_step)
        return observations

    def undelayed(self, observations: np.ndarray) -> np.ndarray:
        """The observations of one run, (T, n), at the time at which they were true, where some sensors are late."""
        for effect in reversed(self.effects):
            if isinstance(effect, ObservationDelay) and not effect.is_neutral and not _all_late(effect):
                observations = effect.restore(observations, self.control_step)
        return observations

    def rollout(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        *,
        time: np.ndarray | None = None,
        applied: np.ndarray | None = None,
    ) -> np.ndarray:
        """Steps many states at once.

        Args:
            states: (B, nq + nv), where to start from.
            actions: (B, H, nu), executed for H control steps.
            time: (B), of the start, in s; 0 by default.
            applied: (B, H, nv), generalised forces in N or N·m beside those of the effects.

        Returns:
            The states after each control step, (B, H, nq + nv); NaN from where the simulation diverges on.
        """
        batch, horizon, _ = actions.shape
        size = mujoco.mj_stateSize(self.model, FULL_PHYSICS)
        full = np.zeros((batch, size))
        full[:, 0] = 0.0 if time is None else time
        full[:, 1 : 1 + states.shape[1]] = states
        forces = [e.batched(self.model) for e in self.effects if isinstance(e, ForceEffect) and not e.is_neutral]
        chunk = max(1, _CHUNK // (horizon * self.frame_skip * size))
        parts = []
        with _no_warnings():
            for rows in (slice(i, i + chunk) for i in range(0, batch, chunk)):
                own = None if applied is None else applied[rows]
                parts.append(
                    roll_out(
                        self._pool,
                        self.model,
                        self._data,
                        full[rows],
                        actions[rows],
                        self.frame_skip,
                        forces=forces,
                        applied=own,
                    )
                )
        reached = np.concatenate(parts) if parts else np.zeros((0, horizon, size))
        # MuJoCo starts anew, and its clock with it, where a state is not finite or far too large
        expected = full[:, :1] + self.control_step * np.arange(1, horizon + 1)
        diverged = np.maximum.accumulate(np.abs(reached[:, :, 0] - expected) > 0.5 * self.control_step, axis=1)
        reached = reached[:, :, 1 : 1 + states.shape[1]].copy()
        reached[diverged] = np.nan
        return reached


@contextmanager
def _no_warnings() -> Iterator[None]:
    """Keeps MuJoCo from writing to console and file that a simulation diverged: whoever tries values sees NaN."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _all_late(effect: Effect) -> bool:
    return isinstance(effect, ObservationDelay) and effect.entries is None
