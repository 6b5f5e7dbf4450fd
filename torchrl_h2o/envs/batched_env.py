"""A TorchRL env of many MuJoCo worlds of one task, stepped at once with ``mujoco.rollout``."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial
from os import cpu_count
from typing import Any, cast

import mujoco
import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.wrappers import TimeLimit
from mujoco.rollout import Rollout
from tensordict import TensorDict, TensorDictBase
from torchrl._utils import seed_generator
from torchrl.data import Composite
from torchrl.envs import EnvBase

from torchrl_h2o.effects import (
    ActionEffect,
    Effect,
    ObservationEffect,
    Pipeline,
    effect_from_dict,
    effect_to_dict,
)
from torchrl_h2o.effects.effect import checked_effects
from torchrl_h2o.effects.model.compilation import require_changes
from torchrl_h2o.effects.states import BatchedForce, States, Variation
from torchrl_h2o.envs.backends.gymnasium import GymnasiumBackend
from torchrl_h2o.envs.dynamics_gap import DrawEffects, DynamicsGap, GapContent, transforms_of
from torchrl_h2o.envs.mujoco_model import find_backend
from torchrl_h2o.envs.physics import FULL_PHYSICS, positions_and_velocities, roll_out
from torchrl_h2o.envs.recorded_episode import RecordedEpisode
from torchrl_h2o.envs.task_rules import rules_of

_ROUNDING = 1e-5  # share of an action's bound by which the rounding of a policy may exceed it


class BatchedMujocoEnv(EnvBase):
    """N worlds of a Gymnasium MuJoCo task, stepped at once on all processors.

    Observations, rewards, terminations, resets and the time limit are those of the task; for the same states and
    actions they equal Gymnasium's up to rounding. Worlds are reset individually, through TorchRL's ``"_reset"``.

    The effects of the given env (its :class:`~torchrl_h2o.envs.DynamicsGap`) act in every world. Further effects are
    common to all worlds, or differ between worlds for domain randomisation.

    Args:
        env: one env of the task, with or without dynamics gaps. The batched env keeps it, to draw initial states. Put
            other transforms around the batched env.
        num_worlds: number of worlds, N.
        effects: further effects for all worlds, or one list of effects per world, or a function from a
            ``numpy.random.Generator`` to a list of effects, which draws those of a world anew at each of its resets. A
            drawn :class:`~torchrl_h2o.envs.DynamicsGap` on the given env is drawn for each world too.

    Keyword Args:
        num_threads: number of threads of ``mujoco.rollout``, at most one per world; the number of processors by
            default.

    Attributes:
        states: MuJoCo's full physics state of each world (time, positions, velocities, activations), (N, size). The
            caller may write to them.
        physics_steps: physics steps per control step.

    Raises:
        ValueError: if the env is not a Gymnasium MuJoCo task with implemented rules, repeats actions or has transforms
            other than dynamics gaps; if the number of lists of effects is not N; if a model effect changes nothing in
            the model; and in a step, if an action is NaN or outside its bounds.

    Examples:
        >>> import numpy as np
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_h2o.effects import Gravity
        >>> from torchrl_h2o.envs import BatchedMujocoEnv
        >>> env = BatchedMujocoEnv(GymEnv("HalfCheetah-v5"), 4, [[Gravity(g)] for g in np.linspace(0.5, 2.0, 4)])
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([4, 3, 1])
    """

    def __init__(
        self,
        env: EnvBase,
        num_worlds: int,
        effects: Sequence[Effect] | Sequence[Sequence[Effect]] | DrawEffects = (),
        *,
        num_threads: int | None = None,
    ) -> None:
        if num_worlds < 1:
            raise ValueError(f"num_worlds is {num_worlds}; there must be at least one world")
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_worlds]))
        backend = _backend_in(env)
        self._task = backend.owner
        self._rules = rules_of(self._task)
        self.num_worlds = num_worlds
        self.max_episode_steps = _time_limit(backend.env)
        self._backend = backend
        of_gaps = [cast("GapContent", gap).draw or effects for gap, effects in backend.gaps.items()]
        self._sources = [(*of_gaps, own) for own in _of_each_world(effects, num_worlds)]
        self._is_drawn = any(callable(source) for sources in self._sources for source in sources)
        self._pipelines = [self._drawn(index, np.random.default_rng(index)) for index in range(num_worlds)]
        self.physics_steps = self._task.frame_skip
        # those of one world, because the worlds differ in values more than in kinds of effects
        require_changes(backend.spec(), max(self._pipelines, key=lambda pipeline: len(pipeline.effects)).effects)
        self._models = self._compiled()
        threads = min(num_threads or cpu_count() or 1, num_worlds)
        self._pool = Rollout(nthread=threads if threads > 1 else 0)  # 0 runs in the calling thread
        self._data = [mujoco.MjData(self._models[0]) for _ in range(max(1, self._pool.nthread))]
        self.states = np.zeros((num_worlds, mujoco.mj_stateSize(self._models[0], FULL_PHYSICS)))
        self._steps = np.zeros(num_worlds, dtype=np.int64)
        self._control_steps = np.array([self.physics_steps * model.opt.timestep for model in self._models])
        self._episodes = [self._begin_episode(index) for index in range(num_worlds)]
        self._prepare_effects()
        self._make_specs(backend.env)
        self.set_seed(int(torch.randint(2**31, ())))

    @property
    def models(self) -> Sequence[mujoco.MjModel]:
        """The model of each world, with its effects."""
        return self._models

    def _compiled(self) -> list[mujoco.MjModel]:
        """Compiles one model per world; worlds with the same effects share a model."""
        models = {pipeline: self._compile(pipeline) for pipeline in dict.fromkeys(self._pipelines)}
        return [models[pipeline] for pipeline in self._pipelines]

    def _compile(self, pipeline: Pipeline) -> mujoco.MjModel:
        model = pipeline.compile(self._backend.spec())
        self._backend.check_sizes(model)
        return model

    def _drawn(self, index: int, rng: np.random.Generator) -> Pipeline:
        """Returns the effects of a world in its next episode."""
        parts = [source(rng) if callable(source) else source for source in self._sources[index]]
        return Pipeline(tuple(effect for part in parts for effect in checked_effects(part)))

    def _put_into_world(self, index: int, pipeline: Pipeline) -> None:
        """Replaces the effects of one world; the caller then calls :meth:`_prepare_effects`."""
        if pipeline != self._pipelines[index]:
            self._pipelines[index], self._models[index] = pipeline, self._compile(pipeline)
            self._control_steps[index] = self.physics_steps * self._models[index].opt.timestep

    def _prepare_effects(self) -> None:
        """Stores what the worlds' effects alter; each force acts only in its own worlds."""
        worlds: dict[Pipeline, list[int]] = {}
        for index, pipeline in enumerate(self._pipelines):
            worlds.setdefault(pipeline, []).append(index)
        self._differ = len(worlds) > 1
        self._alters_actions = any(pipeline.of_kind(ActionEffect) for pipeline in worlds)
        self._alters_observations = any(pipeline.of_kind(ObservationEffect) for pipeline in worlds)
        self._forces: list[BatchedForce] = [
            _in_worlds(np.array(own), force)
            for pipeline, own in worlds.items()
            for force in pipeline.batched_forces(self._models[own[0]])
        ]
        self._variations = [
            _variation_in_worlds(np.array(own), variations)
            for pipeline, own in worlds.items()
            if (variations := pipeline.variations(self._models[own[0]]))
        ]
        if self._variations and len({id(model) for model in self._models}) < self.num_worlds:
            self._models = [copy(model) for model in self._models]  # the numbers of each world are written into it

    def _make_specs(self, env: EnvBase) -> None:
        n = self.num_worlds
        self.observation_spec = env.observation_spec.expand(torch.Size((n,)))
        self.action_spec = env.action_spec_unbatched.expand(torch.Size((n, *env.action_spec_unbatched.shape)))
        self.reward_spec = env.reward_spec.expand(torch.Size((n, *env.reward_spec.shape)))
        done = {key: spec.expand(torch.Size((n, 1))) for key, spec in env.full_done_spec.items()}
        self.done_spec = Composite(done, shape=torch.Size((n,)))
        # stored here, because looking up a spec in every step is slow
        self._observation_dtype = env.observation_spec["observation"].dtype
        self._reward_dtype = env.reward_spec.dtype
        space = cast("Any", env.action_spec_unbatched).space
        self._bounds = space.low.numpy(), space.high.numpy()

    def _set_seed(self, seed: int | None) -> None:
        self._generators = []
        for _ in range(self.num_worlds):
            self._generators.append(seeding.np_random(seed)[0])
            seed = None if seed is None else seed_generator(seed)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = np.ones(self.num_worlds, dtype=bool)
        if tensordict is not None and (chosen := tensordict.get("_reset", None)) is not None:
            mask = chosen.reshape(self.num_worlds, -1).any(1).numpy()
        if self._is_drawn:
            for index in map(int, np.flatnonzero(mask)):
                self._put_into_world(index, self._drawn(index, self._generators[index]))
            self._prepare_effects()
        for index in map(int, np.flatnonzero(mask)):
            self._begin(index)
        done = torch.zeros(self.num_worlds, 1, dtype=torch.bool)
        return TensorDict(
            {"observation": self._observe(mask), "done": done, "terminated": done.clone(), "truncated": done.clone()},
            batch_size=self.batch_size,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action").numpy()
        self._require_within_bounds(action)
        executed = action
        if self._alters_actions:
            executed = np.stack([episode.executed(own) for episode, own in zip(self._episodes, action, strict=True)])
            executed = executed.astype(action.dtype)
        before = positions_and_velocities(self._models[0], self.states)[0].copy()
        reached = roll_out(
            self._pool,
            self._models if self._differ or self._variations else self._models[0],
            self._data,
            self.states,
            executed[:, None].astype(float),
            self.physics_steps,
            forces=self._forces,
            variations=self._variations,
        )
        self.states[:] = reached[:, 0]
        self._steps[:] += 1
        qpos, qvel = positions_and_velocities(self._models[0], self.states)
        paid = self._rules.reward(before, qpos, qvel, executed, self._control_steps)
        terminated = self._rules.is_terminated(qpos, qvel)
        truncated = self._steps >= self.max_episode_steps
        return TensorDict(
            {
                "observation": self._observe(),
                "reward": torch.as_tensor(paid, dtype=self._reward_dtype).unsqueeze(-1),
                "terminated": torch.from_numpy(terminated).unsqueeze(-1),
                "truncated": torch.from_numpy(truncated).unsqueeze(-1),
                "done": torch.from_numpy(terminated | truncated).unsqueeze(-1),
            },
            batch_size=self.batch_size,
        )

    def _begin(self, index: int) -> None:
        """Begins an episode in one world: the task draws the initial state with the world's own generator."""
        task = self._task
        task.np_random = self._generators[index]
        mujoco.mj_resetData(task.model, task.data)
        task.reset_model()
        state = self.states[index]
        mujoco.mj_getState(task.model, task.data, state, FULL_PHYSICS)
        # coordinates that start at the model's qpos0 follow the world's model; a task's own initial values stay
        own, qpos0 = self._models[index].qpos0, task.model.qpos0
        state[1 : 1 + len(own)] += np.where(task.init_qpos == qpos0, own - qpos0, 0.0)
        self._steps[index] = 0
        self._episodes[index] = self._begin_episode(index)

    def _require_within_bounds(self, action: np.ndarray) -> None:
        low, high = self._bounds
        slack = _ROUNDING * np.maximum(np.abs(low), np.abs(high))
        outside = ~((action >= low - slack) & (action <= high + slack))  # this form also finds NaN
        if outside.any():
            world, entry = (int(place) for place in np.argwhere(outside)[0])
            raise ValueError(
                f"the action of world {world} is {action[world, entry]:g} in entry {entry}, outside of "
                f"[{low[entry]:g}, {high[entry]:g}]; clip it, or use a policy with the env's action_spec"
            )

    def _begin_episode(self, index: int) -> RecordedEpisode:
        """Begins an episode of a world's action and observation effects."""
        # without random effects torch's generator is not used
        seed = int(torch.randint(2**63 - 1, ())) if self._pipelines[index].is_random else None
        return RecordedEpisode(partial(self._pipelines[index].begin, self._control_steps[index]), seed)

    def episodes_state(self) -> dict[str, Any]:
        """Returns the current episodes of all worlds, to be continued by :meth:`restore_episodes`.

        The generators of initial states are not included; ``set_seed`` sets them.
        """
        return {
            "states": torch.from_numpy(self.states.copy()),
            "steps": torch.from_numpy(self._steps.copy()),
            "effects": [episode.state() for episode in self._episodes],
            "drawn": [[effect_to_dict(effect) for effect in p.effects] for p in self._pipelines] * self._is_drawn,
        }

    def restore_episodes(self, state: dict[str, Any]) -> None:
        """Continues the episodes that :meth:`episodes_state` returned, in an env of the same task and effects."""
        self.states[:] = state["states"].numpy()
        self._steps[:] = state["steps"].numpy()
        for index, drawn in enumerate(state.get("drawn", [])):
            self._put_into_world(index, Pipeline(tuple(map(effect_from_dict, drawn))))
        self._prepare_effects()
        self._episodes = [
            RecordedEpisode.restored(partial(pipeline.begin, step), own)
            for pipeline, step, own in zip(self._pipelines, self._control_steps, state["effects"], strict=True)
        ]

    def _observe(self, mask: np.ndarray | slice = slice(None)) -> torch.Tensor:
        """Returns observations (N, n), with sensor effects in the worlds of a mask; TorchRL ignores other worlds."""
        observed = self._rules.observe(*positions_and_velocities(self._models[0], self.states))
        if self._alters_observations:
            for index in np.arange(self.num_worlds)[mask]:
                observed[index] = self._episodes[index].observed(observed[index])
        return torch.as_tensor(observed, dtype=self._observation_dtype)


def _in_worlds(worlds: np.ndarray, force: BatchedForce) -> BatchedForce:
    """Restricts a force to some worlds; it is zero in the others."""

    def forces(states: States) -> np.ndarray:
        everywhere = np.zeros(states.qvel.shape)
        everywhere[worlds] = force(States(*(part[worlds] for part in states)))
        return everywhere

    return forces


def _variation_in_worlds(worlds: np.ndarray, variations: Sequence[Variation]) -> Variation:
    """The variations of some worlds as one of all worlds."""
    fields = tuple(dict.fromkeys(field for variation in variations for field in variation.fields))

    def apply(states: States, values: dict[str, np.ndarray]) -> np.ndarray:
        own, now = {field: values[field][worlds] for field in fields}, States(*(part[worlds] for part in states))
        force = np.zeros(states.qvel.shape)
        for variation in variations:
            force[worlds] += variation.apply(now, own)
        for field in fields:
            values[field][worlds] = own[field]
        return force

    return Variation(fields, apply)


def _of_each_world(
    effects: Sequence[Effect] | Sequence[Sequence[Effect]] | DrawEffects, num_worlds: int
) -> Sequence[Sequence[Effect] | DrawEffects]:
    if callable(effects):
        return [effects] * num_worlds
    given = list(effects) if not isinstance(effects, str) else checked_effects(effects)
    if all(isinstance(effect, Effect) for effect in given):
        return [cast("Sequence[Effect]", given)] * num_worlds
    if len(given) != num_worlds:
        raise ValueError(
            f"there are {len(given)} lists of effects for {num_worlds} worlds: give one per world, or one for all"
        )
    return cast("Sequence[Sequence[Effect]]", given)


def _backend_in(env: EnvBase) -> GymnasiumBackend:
    """Returns the backend of an env that a batch can step; raises ValueError for other envs."""
    backend = find_backend(env)
    if not isinstance(backend, GymnasiumBackend):
        raise ValueError(f"{env} is not a Gymnasium task; build one world with GymEnv")
    others = [type(transform).__name__ for transform in transforms_of(env) if not isinstance(transform, DynamicsGap)]
    if others:
        raise ValueError(
            f"the given env has transforms that the batched env would ignore ({', '.join(others)}): put them around "
            "the batched env, TransformedEnv(BatchedMujocoEnv(...), ...)"
        )
    if backend.env.wrapper_frame_skip != 1:
        raise ValueError("the given env repeats actions (frame_skip); build it without frame_skip")
    return backend


def _time_limit(env: EnvBase) -> float:
    """Returns the number of steps after which the task's TimeLimit wrapper truncates; infinite without one."""
    wrapper = cast("Any", env._env)
    while wrapper is not wrapper.unwrapped:
        if isinstance(wrapper, TimeLimit):
            return wrapper._max_episode_steps
        wrapper = wrapper.env
    return np.inf
