"""A simulator that takes effects and is stepped from many states at once.

All steps run through ``mujoco.rollout``. One control step is ``frame_skip`` physics steps under one action.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import cpu_count
from pathlib import Path

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from torchrl.envs import EnvBase

from torchrl_h2o.data.audit.log import find_pairs
from torchrl_h2o.effects import CatalogueEntry, Effect, ModelEffect, Pipeline, VaryingEffect, catalogue, joint_names
from torchrl_h2o.effects.model.compilation import with_small_textures
from torchrl_h2o.envs.physics import ALONE, FULL_PHYSICS, roll_out
from torchrl_h2o.residuals.simulation.activations import (
    activations_along,
    actuators_of_unknown_activation,
    settled_activations,
)
from torchrl_h2o.residuals.simulation.source import SimulatorSource, source_of_env, source_of_mjcf
from torchrl_h2o.residuals.simulation.state_map import StateMap, hidden_coordinates

# float64 values that one call of mujoco.rollout returns at most, 128 MB; larger rollouts are split
_ROLLOUT_NUMBERS = 2**24
# share of the control step by which the simulated time may differ from the expected one. MuJoCo resets a diverging
# simulation and its clock, so a larger difference marks divergence.
_CLOCK_JUMP = 0.5

_COPIES = 128  # states that are stepped together if numbers of the model depend on the state
STEPS_BETWEEN_CHECKS = 50_000  # physics steps, about a second for a robot with twelve joints


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulator with its control step, its observation and its effects.

    Two simulations are equal if they have the same source and equal effects.

    Args:
        spec: returns the model's specification, parsed anew at each call.
        frame_skip: physics steps per control step.
        state_map: the map between observations and states.
        effects: the effects in the simulator, in their order.
        name: the name for reports.
        action_units: units of the action's entries, (nu), for reports; empty if they are not known.
        check: called before every few thousand simulated steps; it raises to end a computation whose time is up.

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
    action_units: tuple[str, ...] = ()
    check: Callable[[], object] = field(default=lambda: None, repr=False)
    _pool: Rollout = field(default_factory=lambda: Rollout(nthread=cpu_count()), repr=False)

    @classmethod
    def from_env(cls, env: EnvBase) -> Simulation:
        """Builds the simulation of a TorchRL env of a Gymnasium MuJoCo task, with the env's dynamics gaps.

        Args:
            env: a GymEnv of a MuJoCo task, with or without transforms.

        Raises:
            ValueError: if the env is no Gymnasium MuJoCo task, its observation is not linear in the state, or an
                actuator has an activation that the commands do not tell, such as a muscle.
        """
        return cls._from_source(source_of_env(env))

    @classmethod
    def from_mjcf(
        cls,
        path: str | Path,
        state_map: StateMap | Sequence[str] | Mapping[str, str],
        control_step: float,
        effects: Sequence[Effect] = (),
    ) -> Simulation:
        """Builds the simulation of an MJCF file.

        Args:
            path: the file.
            state_map: a map; or the names of the observed coordinates, in the order of the data, where a joint's name
                stands for its position and the name with ``_velocity`` appended for its velocity; or a mapping
                from the columns of a log to these names.
            control_step: the time between two rows of the data, in s. If it is no multiple of the model's timestep, the
                timestep is reduced to the next one that fits.
            effects: effects to put into the simulator.

        Raises:
            ValueError: for names that the model does not have, a control step that is not positive, or an actuator
                whose activation the commands do not tell, such as a muscle.
        """
        return cls._from_source(source_of_mjcf(path, state_map, control_step, effects))

    @classmethod
    def _from_source(cls, source: SimulatorSource) -> Simulation:
        """Builds the simulation of a source and marks the hidden coordinates in its state map."""
        simulation = cls(*source)
        if unknown := actuators_of_unknown_activation(simulation.model):
            raise ValueError(
                f"{source.name}: the activation of {', '.join(unknown)} is not in the data, and the commands do not "
                "tell it; use actuators without dynamics, or enabled ones with dyntype filter or filterexact, no delay"
            )
        state_map = source.state_map
        hidden = hidden_coordinates(state_map, simulation.model.nu, simulation.rollout)
        return replace(simulation, state_map=replace(state_map, hidden=hidden))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Simulation) and self._identity == other._identity

    def __hash__(self) -> int:
        return hash(self._identity)

    @property
    def _identity(self) -> tuple:
        return type(self), self.spec, self.frame_skip, id(self.state_map), self.effects

    @cached_property
    def pipeline(self) -> Pipeline:
        """The effects and how they are applied."""
        return Pipeline(self.effects)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model with the model effects in it, and with textures of one pixel."""
        return self.pipeline.compile(with_small_textures(self.spec()))

    @property
    def control_step(self) -> float:
        """The time between two actions, in s."""
        return self.frame_skip * self.model.opt.timestep

    @property
    def actuators(self) -> tuple[str, ...]:
        """The names of the action's entries; the index of an entry without a name."""
        return tuple(self.model.actuator(i).name or str(i) for i in range(self.model.nu))

    @property
    def names(self) -> dict[str, Sequence[str]]:
        """The names and units of observations, actuators and joints, for :meth:`Effect.describe`."""
        return {
            "entries": self.state_map.names,
            "entry_units": self.state_map.units,
            "actuators": self.actuators,
            "actuator_units": self.action_units,
            **joint_names(self.model),
        }

    @cached_property
    def _scratch(self) -> threading.local:
        """Scratch space of each thread that steps this model."""
        return threading.local()

    @property
    def _copies(self) -> list[mujoco.MjModel]:
        """Copies of the model, of each thread, into which numbers that depend on the state are written."""
        if not hasattr(self._scratch, "copies"):
            self._scratch.copies = [copy(self.model) for _ in range(_COPIES)]
        return self._scratch.copies

    @property
    def _workers(self) -> tuple[Rollout, list[mujoco.MjData]]:
        """Threads and scratch space for a rollout. Other threads than the main one step on their own."""
        pool = self._pool if threading.current_thread() is threading.main_thread() else ALONE
        if not hasattr(self._scratch, "data"):
            self._scratch.data = [mujoco.MjData(self.model) for _ in range(max(1, pool.nthread))]
        return pool, self._scratch.data

    @cached_property
    def num_remembered(self) -> int:
        """Number of values that effects remember between physics steps, beside the state of the model."""
        variations = self.pipeline.variations(self.model)
        return sum(one.memory.size for one in variations if one.memory is not None)

    def catalogue(self) -> tuple[CatalogueEntry, ...]:
        """Returns candidate effects that the simulator may lack, sized by the model with the present effects."""
        spec = with_small_textures(self.spec())
        self.pipeline.edit(spec)
        velocities = sorted(pair.velocity for pair in find_pairs(self.state_map, self.model))
        return catalogue(spec, num_observations=len(self.state_map.names), dt=self.control_step, velocities=velocities)

    def with_effects(self, *effects: Effect) -> Simulation:
        """Returns the simulation with more effects, appended to the present ones."""
        more = replace(self, effects=(*self.effects, *effects))
        if not any(isinstance(effect, ModelEffect) for effect in effects):
            # the model is unchanged, so it is not compiled again, for example for each trial value of a delay
            more.__dict__.update(model=self.model, _scratch=self._scratch)
        return more

    @cached_property
    def quick(self) -> Simulation:
        """The simulation with Euler's steps in place of RK4's, for derivatives: that takes a quarter of the time."""
        if self.model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
            return self

        def spec() -> mujoco.MjSpec:
            with_euler = self.spec()
            with_euler.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
            return with_euler

        return replace(self, spec=spec)

    def executed(self, actions: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Returns the executed actions of one recorded run, (T, nu); see :meth:`Pipeline.executed_run`.

        Args:
            actions: the recorded actions, (T, nu).
            rng: the generator of random effects, which are skipped without it.
        """
        return self.pipeline.executed_run(actions, self.control_step, rng)

    def activations(self, actions: np.ndarray) -> np.ndarray:
        """Returns the actuators' activations, (T, na), before each executed action, (T, nu), of one recorded run."""
        return activations_along(self.model, actions, self.frame_skip)

    def true_observations(self, observations: np.ndarray) -> np.ndarray:
        """Undoes the sensor effects of a recorded run, (T, n); NaN if impossible; see :meth:`Pipeline.restore_run`."""
        return self.pipeline.restore_run(observations, self.control_step)

    def undelayed(self, observations: np.ndarray) -> np.ndarray:
        """Undoes the delays of single sensors in one recorded run, (T, n); see :meth:`Pipeline.undelay_run`."""
        return self.pipeline.undelay_run(observations, self.control_step)

    def observed(self, states: np.ndarray) -> np.ndarray:
        """Returns the observations (..., n) of states (..., nq + nv) with memoryless, non-random effects."""
        return self.pipeline.observe_memoryless(self.state_map.observations(states), self.control_step)

    def rollout(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        *,
        time: np.ndarray | None = None,
        activations: np.ndarray | None = None,
        applied: np.ndarray | None = None,
    ) -> np.ndarray:
        """Steps many states at once.

        Args:
            states: initial states, (B, nq + nv).
            actions: executed actions of H control steps, (B, H, nu).
            time: initial time in s, (B,); 0 by default.
            activations: initial activations of the actuators, (B, na); by default those after a long time under the
                first actions. Further columns are what effects remember, (B, na + r); it is not known where it is NaN.
            applied: generalised forces in N or N·m, (B, H, nv), added to those of the effects.

        Returns:
            The states after each control step, (B, H, nq + nv); NaN from the step on at which the simulation diverges.
        """
        batch, horizon, _ = actions.shape
        full = self._full(states, np.zeros(batch) if time is None else time, activations, actions[:, 0])
        physics_steps = horizon * self.frame_skip
        numbers = _ROLLOUT_NUMBERS // full.shape[-1]
        chunk = max(1, min(numbers, STEPS_BETWEEN_CHECKS) // physics_steps)
        parts = []
        with _no_warnings:
            for rows in (slice(i, i + chunk) for i in range(0, batch, chunk)):
                own = None if applied is None else applied[rows]
                known = None if activations is None else activations[rows, self.model.na :]
                parts.append(self._stepped(full[rows], actions[rows], own, known)[0])
        return np.concatenate(parts) if parts else np.zeros((0, horizon, states.shape[1]))

    def follow(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        time: np.ndarray,
        activations: np.ndarray | None = None,
        carried: Sequence[int] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulates the hidden coordinates of many recordings side by side, and what effects remember.

        At each step the observed coordinates begin at the recorded values, and the hidden ones where the step before
        has brought them. Where a simulation diverges, they begin anew.

        Args:
            states: recorded states, (L, B, nq + nv); their hidden coordinates are those to begin with.
            actions: executed actions, (L, B, nu).
            time: time of the states in s, (L, B).
            activations: activations of the actuators, (L, B, na); by default those after a long time under the actions.
            carried: coordinates to simulate in place of the hidden ones.

        Returns:
            After each step, the hidden coordinates, (L, B, hidden), and what effects remember, (L, B, r).
        """
        hidden = np.asarray(self.state_map.hidden if carried is None else carried, int)
        full, places = self._full(states, time, activations, actions), 1 + hidden
        reached = np.empty((*states.shape[:2], len(hidden)))
        memories = np.empty((*states.shape[:2], self.num_remembered))
        now_hidden, memory = states[0][:, hidden], np.full(memories.shape[1:], np.nan)
        with _no_warnings:
            for step, now in enumerate(full):
                now[:, places] = now_hidden
                after, memory = self._stepped(now, actions[step][:, None], None, memory)
                now_hidden = after[:, 0, hidden]
                if not np.isfinite(now_hidden).all():
                    now_hidden = np.where(np.isfinite(now_hidden), now_hidden, states[step][:, hidden])
                reached[step], memories[step] = now_hidden, memory
        return reached, memories

    def _full(
        self, states: np.ndarray, time: np.ndarray, activations: np.ndarray | None, actions: np.ndarray
    ) -> np.ndarray:
        """Full physics states, (..., size), of states (..., nq + nv) at times (...), before actions (..., nu)."""
        full = np.zeros((*states.shape[:-1], mujoco.mj_stateSize(self.model, FULL_PHYSICS)))
        full[..., 0] = time
        after = 1 + states.shape[-1]
        full[..., 1:after] = states
        if self.model.na:
            known = settled_activations(self.model, actions) if activations is None else activations
            full[..., after : after + self.model.na] = known[..., : self.model.na]
        return full

    def _stepped(
        self,
        full: np.ndarray,
        actions: np.ndarray,
        applied: np.ndarray | None = None,
        remembered: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Steps full physics states (B, size), where effects remember something, (B, r).

        Returns:
            The states after each control step, (B, H, nq + nv), NaN where the simulation diverges; and what effects
            remember in the end, (B, r).
        """
        self.check()
        pool, data = self._workers
        varies, parts, memories = bool(self.pipeline.of_kind(VaryingEffect)), [], []
        size = _COPIES if varies else max(1, len(full))
        for rows in (slice(i, i + size) for i in range(0, max(1, len(full)), size)):
            models = self._copies[: len(full[rows])] if varies else self.model
            variations = self.pipeline.variations(self.model)
            remembering = [one.memory for one in variations if one.memory is not None]
            if remembered is not None and remembered.shape[1]:
                ends = np.cumsum([memory.size for memory in remembering])
                for memory, own in zip(remembering, np.split(remembered[rows], ends[:-1], axis=1), strict=True):
                    memory.write(own)
            pushes = {
                "forces": self.pipeline.batched_forces(self.model),
                "variations": variations,
                "applied": None if applied is None else applied[rows],
            }
            parts.append(roll_out(pool, models, data, full[rows], actions[rows], self.frame_skip, **pushes))
            memories.append(np.hstack([np.empty((len(full[rows]), 0)), *(memory.read() for memory in remembering)]))
        reached = np.concatenate(parts)
        # MuJoCo resets a simulation and its clock if the state is not finite or too large
        control_step = self.control_step
        expected = full[:, :1] + control_step * np.arange(1, actions.shape[1] + 1)
        jumps = np.abs(reached[:, :, 0] - expected) > _CLOCK_JUMP * control_step
        states = reached[:, :, 1 : 1 + self.model.nq + self.model.nv].copy()
        if jumps.any():
            states[np.maximum.accumulate(jumps, axis=1)] = np.nan
        return states, np.concatenate(memories)


class _NoWarnings:
    """Suppresses MuJoCo's divergence warnings on the console and in its log file; the result is NaN instead.

    The handler of warnings is global, so it is restored when the last of the threads that suppress them leaves.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(lambda message: None)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                mujoco.set_mju_user_warning(self._before)


_no_warnings = _NoWarnings()
