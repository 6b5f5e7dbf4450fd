"""DynamicsGap, the TorchRL transform that applies effects to a simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, FrameSkipTransform, Transform, TransformedEnv

from torchrl_h2o.effects import ActionEffect, Effect, ObservationEffect, Pipeline, paper_gap
from torchrl_h2o.effects.effect import checked_effects
from torchrl_h2o.effects.model.compilation import require_changes
from torchrl_h2o.envs.backends.backend import MujocoBackend
from torchrl_h2o.envs.episode import GapEpisode
from torchrl_h2o.envs.mujoco_model import find_backend

DrawEffects = Callable[[np.random.Generator], Sequence[Effect]]


class DynamicsGap(Transform):
    """Applies a list of effects to a simulator.

    Model effects act when the transform is added to an env: they edit the task's own MJCF in memory, and the compiled
    result replaces the model in use. Reset the env afterwards. Action effects alter what the simulator executes, while
    the tensordict keeps the commanded action. Observation effects act before any other transform reads the
    observation. Forces act at every physics step.

    Effects compose in their order: model edits first to last before one compilation, action effects first to last,
    forces summed, observation effects first to last. With several gaps on one env, the model edits of the innermost
    gap come first; actions pass through the outermost gap first, as through all TorchRL transforms.

    Negative :class:`~torchrl_h2o.effects.ActionNoise` removes noise that the effects before it add, in the same gap and
    in all gaps nearer to the simulator.

    A gap belongs to one simulator permanently: removing the transform from the env does not restore the simulator, and
    another gap needs a new env. Put the gap directly on the env, before other transforms, and inside each worker of a
    batched env. In a copy of the env, the gaps are applied again at the first reset.

    A function instead of effects draws the gap anew at each reset, for domain randomisation: it gets a random generator
    and returns a list of effects. Effects that are assigned to :attr:`effects` also act from the next reset on.

    Gaps are drawn from the task's own random generator, so the env's ``set_seed`` repeats them. The random effects of
    an episode are seeded at its reset from torch's global generator, so ``torch.manual_seed`` repeats them. In
    ``ParallelEnv`` each worker has its own generators; the env's ``set_seed`` makes them differ.

    Observation effects receive the env's floating-point observations as one vector, in the order of the observation
    spec.

    Args:
        *effects: the effects, in their order; or one function from a ``numpy.random.Generator`` to such a list.

    Raises:
        TypeError: if an argument is not an effect.
        ValueError: when added to an env that is batched, does not run on MuJoCo or had another gap; if the model has
            no element that one of the effects could act on, or a model effect changes nothing in it; if negative noise
            exceeds the noise before it; or if action or observation effects are added after transforms of other kinds.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_h2o.effects import ActionNoise, Gravity
        >>> from torchrl_h2o.envs import DynamicsGap, mujoco_model
        >>> gap = DynamicsGap(Gravity(2.0), ActionNoise(0.1))
        >>> gap
        DynamicsGap(gravity × 2, noise of standard deviation 0.1 on all actuators)
        >>> env = TransformedEnv(GymEnv("HalfCheetah-v5"), gap)
        >>> float(mujoco_model(env).opt.gravity[2])
        -19.62
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([3, 1])

        Another gravity in every episode:

        >>> drawn = DynamicsGap(lambda rng: [Gravity(rng.uniform(0.5, 2.0))])
        >>> env = TransformedEnv(GymEnv("HalfCheetah-v5"), drawn)
        >>> gravities = []
        >>> for _ in range(3):
        ...     _ = env.reset()
        ...     gravities.append(float(mujoco_model(env).opt.gravity[2]))
        >>> len(set(gravities))
        3
    """

    def __init__(self, *effects: Effect | DrawEffects):
        super().__init__()
        # TorchRL clones transforms, sometimes onto the same env. Clones share this object, which identifies the gap
        # and its current episode in the simulation.
        self._identity = GapContent()
        if len(effects) == 1 and callable(effects[0]) and not isinstance(effects[0], type):
            self._identity.draw = cast("DrawEffects", effects[0])
        else:
            self._identity.effects = checked_effects(effects)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects of the current episode. Others may be assigned; they act from the next reset on."""
        return self._identity.effects

    @effects.setter
    def effects(self, effects: Sequence[Effect]) -> None:
        self._identity.effects, self._identity.draw = checked_effects(effects), None
        self._identity.is_new = True

    @property
    def draw(self) -> DrawEffects | None:
        """The function that draws the effects at each reset; None if they are fixed."""
        return self._identity.draw

    def describe(self) -> str:
        """Describes the gap in words with units."""
        words = ", ".join(effect.describe() for effect in self.effects)
        return f"drawn at each reset: {words or 'not yet'}" if self.draw is not None else words

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.describe()})"

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        env = _env_of(self)
        if env is None:  # the transform is in a Compose that has not been added to an env yet
            return
        backend = find_backend(env)
        is_new = self._identity not in backend.gaps  # TorchRL also adds clones of a gap in use
        if self.draw is not None and is_new:
            self._identity.effects = checked_effects(self.draw(np.random.default_rng(0)))
        self._check_place(env)
        # a trial episode, so that an effect that does not fit the model raises before the model is changed
        trial = self._begin(backend, self._pipeline(backend), np.random.default_rng(0))
        example = backend.env.fake_tensordict()
        trial.execute(example)
        trial.observe(example)
        for force in trial.effects.forces:
            force(mujoco.MjData(backend.model))
        if is_new:
            require_changes(backend.spec(), self.effects)
        backend.apply(self._identity, {gap._identity: gap.effects for gap in self._gaps_on(env)})

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        # a copied or unpickled env may have rebuilt its simulator without the gaps
        env = self._own_env()
        backend = find_backend(env)
        if self.draw is not None:
            self._identity.effects = checked_effects(self.draw(backend.generator()))
        elif self._identity.is_new:
            require_changes(backend.spec(), self.effects)
            self._identity.is_new = False
        self._check_place(env)
        gaps = self._gaps_on(env)
        effects: dict[object, tuple[Effect, ...]] = {gap._identity: gap.effects for gap in gaps}
        if len(effects) < len(gaps):
            raise ValueError(
                f"{self} and a clone of it are on one env, where they count as one gap; to apply its effects twice, "
                "make a second DynamicsGap"
            )
        for identity in effects:
            backend.apply(identity, effects)
        return super()._reset_env_preprocess(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        find_backend(self._own_env()).episodes.pop(self._identity, None)
        return self._call(tensordict_reset)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._episode().execute(tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._episode().observe(next_tensordict)

    def _own_env(self) -> EnvBase:
        """The env of a transform that is on one, as in all methods that an env calls."""
        return cast("EnvBase", _env_of(self))

    def _episode(self) -> GapEpisode:
        """The current episode; begins one if there is none."""
        env = _env_of(self)
        if env is None:  # in a replay buffer there is no simulator to alter
            return GapEpisode()
        backend = find_backend(env)
        episodes = backend.episodes
        if self._identity not in episodes:
            rng, pipeline = None, self._pipeline(backend)
            # Without random effects torch's generator is not used, so that runs with and without
            # the gap sample the same actions.
            if pipeline.is_random:
                rng = np.random.default_rng(int(torch.randint(2**63 - 1, ())))
            episodes[self._identity] = self._begin(backend, pipeline, rng)
        return episodes[self._identity]

    def _pipeline(self, backend: MujocoBackend) -> Pipeline:
        """The gap's effects, with negative noise subtracted across all gaps of the simulation."""
        # backend.gaps also lists gaps on envs around this one, but not yet a gap that is being added
        of_gap = {gap._identity: gap.effects for gap in self._gaps_on(self._own_env())} | dict(backend.gaps)
        return Pipeline.balanced_together(of_gap)[self._identity]

    @staticmethod
    def _begin(backend: MujocoBackend, pipeline: Pipeline, rng: np.random.Generator | None) -> GapEpisode:
        return GapEpisode.begin(pipeline, backend.env, backend.control_step, backend.model, rng)

    def _gaps_on(self, env: EnvBase) -> list[DynamicsGap]:
        return [transform for transform in _transforms_of(self, env) if isinstance(transform, DynamicsGap)]

    def _check_place(self, env: EnvBase) -> None:
        """Raises ValueError if another transform is between the simulator and this gap's actions or observations."""
        if not any(isinstance(effect, ActionEffect | ObservationEffect) for effect in self.effects):
            return
        transforms = _transforms_of(self, env)
        if any(isinstance(transform, FrameSkipTransform) for transform in transforms):
            raise ValueError(
                f"FrameSkipTransform repeats actions that {self} has altered, so it would alter them again; let the "
                "env itself skip frames: GymEnv(..., frame_skip=...)"
            )
        for transform in transforms[: transforms.index(self)]:
            if not isinstance(transform, DynamicsGap):
                raise ValueError(
                    f"{self} stands after {type(transform).__name__}, so its actions and observations are not those "
                    "of the simulator; put it first: env.insert_transform(0, DynamicsGap(...))"
                )


class GapContent:
    """The effects of a gap, shared by its clones; the object itself identifies the gap."""

    effects: tuple[Effect, ...] = ()
    draw: DrawEffects | None = None
    is_new: bool = False  # assigned since the last reset


def dynamics_gap(name: str, strength: float | None = None) -> DynamicsGap:
    """Builds one of the paper's dynamics gaps by its name.

    Args:
        name: ``gravity``, ``friction``, ``joint_noise``, ``big_thigh``, ``small_thigh``,
            ``broken_thigh``, ``flexible_thigh``, ``long_torso`` or ``soft_feet``; see
            :func:`~torchrl_h2o.effects.paper_gap`.
        strength: the factor, or for ``joint_noise`` the standard deviation; the paper's value by default.

    Returns:
        The transform.

    Raises:
        ValueError: for an unknown gap or a strength out of bounds.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_h2o.envs import dynamics_gap, mujoco_model
        >>> env = TransformedEnv(GymEnv("HalfCheetah-v5"), dynamics_gap("long_torso"))
        >>> model = mujoco_model(env)
        >>> print(model.geom("torso").size[1], "m,", model.body_mass.sum().round(6), "kg")
        2.0 m, 14.0 kg

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, simulation experiments.
    """
    return DynamicsGap(paper_gap(name, strength))


def _env_of(transform: Transform) -> EnvBase | None:
    """Returns the env of a transform, or None if it has none; Transform.container raises in that case."""
    container = transform
    while isinstance(container, Transform):
        reference = container.__dict__["_container"]
        container = None if reference is None else reference()
    return container


def _transforms_of(transform: Transform, env: EnvBase) -> list[Transform]:
    """Returns all transforms of a transform's env, the innermost first, also while the transform is being added."""
    root = transform
    while isinstance(container := root.__dict__["_container"](), Transform):
        root = container
    return [*transforms_of(cast("TransformedEnv", env).base_env), *transforms_of(root)]


def transforms_of(node: EnvBase | Transform) -> list[Transform]:
    """Returns all transforms in an env or a transform, the innermost first."""
    if isinstance(node, TransformedEnv):
        return [*transforms_of(node.base_env), *transforms_of(node.transform)]
    if isinstance(node, Compose):
        return [leaf for child in node for leaf in transforms_of(cast("Transform", child))]
    return [node] if isinstance(node, Transform) else []
