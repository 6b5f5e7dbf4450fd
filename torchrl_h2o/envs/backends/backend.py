"""The interface to the MuJoCo simulation inside a TorchRL env, common to Gymnasium and dm_control.

It provides the operations for :class:`~torchrl_h2o.envs.DynamicsGap` and :class:`~torchrl_h2o.envs.BatchedMujocoEnv`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_h2o.effects import Effect, ForceEffect, ModelEffect, Pipeline, VaryingEffect, compile_model
from torchrl_h2o.effects.model.compilation import saved_model
from torchrl_h2o.effects.states import States
from torchrl_h2o.envs.episode import GapEpisodes

# fields of MjModel that a dynamics gap must not change
_SIZES = ("nq", "nv", "nu", "na", "nbody", "njnt", "ngeom", "nsite", "nsensor")


class MujocoBackend(ABC):
    """The simulation inside one env: access to its model, and replacement of it.

    The applied gaps and their episodes are stored on the object that owns the model. Therefore a copy that is rebuilt
    from the original model lists no gaps, and all clones of a gap on one env, which TorchRL makes, share an episode.

    Args:
        owner: the object that owns model and data; it exists as long as they do.
        env: the TorchRL env around it, without transforms.
    """

    def __init__(self, owner: Any, env: EnvBase):
        self.owner = owner
        self.env = env

    @property
    @abstractmethod
    def model(self) -> mujoco.MjModel:
        """The model in use."""

    @property
    @abstractmethod
    def data(self) -> mujoco.MjData:
        """The simulation state in use."""

    @property
    @abstractmethod
    def control_step(self) -> float:
        """The control step, the time between two actions, in s."""

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """Returns the specification of the model without gaps, parsed anew from its source."""

    @property
    @abstractmethod
    def source(self) -> str:
        """The source of the model without gaps, for error messages."""

    @property
    def written_at_reset(self) -> tuple[str, ...]:
        """The fields of the model that the task itself writes at every reset."""
        return ()

    @abstractmethod
    def load(self, model: mujoco.MjModel) -> None:
        """Replaces the model and data that the simulation and its renderers use."""

    @abstractmethod
    def push(self) -> None:
        """Makes every later physics step apply the forces and the variations of the current episodes."""

    @abstractmethod
    def generator(self) -> np.random.Generator:
        """Returns a new random generator, seeded from that of the task, which the env's ``set_seed`` seeds."""

    @property
    def gaps(self) -> Mapping[object, Sequence[Effect]]:
        """The effects of every applied gap, by the gap's identity, in the order of application."""
        return getattr(self.owner, "_dynamics_gaps", {})

    @property
    def episodes(self) -> GapEpisodes:
        """The current episode of every gap, by the gap's identity."""
        return self.owner.__dict__.setdefault("_dynamics_gap_episodes", GapEpisodes())

    def apply(self, gap: object, on_env: Mapping[object, Sequence[Effect]]) -> None:
        """Applies a gap to the model, after the gaps applied before, and what has changed in these.

        Args:
            gap: the gap's identity; the same object denotes the same gap.
            on_env: the effects of each of the env's gaps by identity, this one included, the innermost first. Action
                and observation effects are ignored.

        Raises:
            ValueError: if the model has no element that an effect could act on, or if a gap was applied that is not
                among the gaps of the env. The simulation is unchanged after the error.
        """
        applied = self.gaps
        wanted = {other: tuple(on_env.get(other, effects)) for other, effects in applied.items()}
        wanted.setdefault(gap, tuple(on_env[gap]))
        if wanted == applied:
            return
        if gap not in applied and not applied.keys() <= on_env.keys():
            left = ", ".join(e.describe() for other in applied if other not in on_env for e in applied[other])
            raise ValueError(
                f"a gap that is not among the transforms of this env was applied to the simulator of {self.env} "
                f"before ({left}) and cannot be removed: make a new env for the new gap"
            )
        if not applied:
            self._check_source([effect for effects in on_env.values() for effect in effects])
        pipeline = _together(wanted)
        if not applied or pipeline.of_kind(ModelEffect) != _together(applied).of_kind(ModelEffect):
            model = pipeline.compile(self.spec())
            self.check_sizes(model)
            model.vis.global_.offwidth = self.model.vis.global_.offwidth
            model.vis.global_.offheight = self.model.vis.global_.offheight
            self.load(model)
        if pipeline.of_kind(ForceEffect) or pipeline.of_kind(VaryingEffect):
            self.push()
        self.owner._dynamics_gaps = wanted

    def _check_source(self, effects: Sequence[Effect]) -> None:
        self.check_sizes(compile_model(self.spec()))
        # dm_control's copies contain the effects of the gaps, but not the list of gaps
        if not self._came_from([]) and not self._came_from(effects):
            raise ValueError(
                f"the model of {self.env} differs from {self.source}: it was changed after loading or built with "
                "other arguments, and a dynamics gap recompiles the source. Make the change an effect of the gap"
            )

    def _came_from(self, effects: Sequence[Effect]) -> bool:
        """Whether the model in use equals the model of the source with these effects."""
        model, source = self.model, compile_model(self.spec(), effects)
        source.vis.global_.offwidth = model.vis.global_.offwidth
        source.vis.global_.offheight = model.vis.global_.offheight
        for field in self.written_at_reset:
            getattr(source, field)[:] = getattr(model, field)
        return saved_model(source) == saved_model(model)

    def check_sizes(self, model: mujoco.MjModel) -> None:
        """Checks that a model has the same joints, bodies and actuators as the one in use.

        Raises:
            ValueError: if a size differs.
        """
        for size in _SIZES:
            ours, theirs = getattr(self.model, size), getattr(model, size)
            if ours != theirs:
                raise ValueError(
                    f"the model of {self.env} has {size} = {ours}, the one compiled for it has "
                    f"{theirs}: a dynamics gap must keep joints, bodies and actuators, and the "
                    "model must come from its file unchanged"
                )

    def _pushed_steps(self, step: Callable[[], None], n_steps: int) -> None:
        """Takes physics steps one by one; each uses the forces and the variations at the state before the step."""
        model, data = self.model, self.data
        forces, variations = self._of_episodes("forces"), self._of_episodes("variations")
        places = {field: getattr(model, field) for variation in variations for field in variation.fields}
        own = {field: place.copy() for field, place in places.items()}
        for _ in range(n_steps):
            # a step of MuJoCo leaves the body positions and velocities at their values before the step
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            others = data.qfrc_applied.copy()
            data.qfrc_applied += sum(force(data) for force in forces)
            values, now = {field: value[None].copy() for field, value in own.items()}, States.of(data)
            for variation in variations:
                data.qfrc_applied += np.ravel(variation.apply(now, values))
            for field, place in places.items():
                place[:] = values[field][0]
            step()
            data.qfrc_applied[:] = others
        for field, place in places.items():
            place[:] = own[field]

    def _of_episodes(self, kind: str) -> list:
        # in the order of the gaps rather than of their resets, because rounding depends on the order of a sum
        episodes = self.episodes
        return [one for gap in self.gaps if gap in episodes for one in getattr(episodes[gap].effects, kind)]


def _together(gaps: Mapping[object, Sequence[Effect]]) -> Pipeline:
    return Pipeline(tuple(effect for effects in gaps.values() for effect in effects))


def base_env(env: EnvBase) -> EnvBase:
    """Returns the innermost env, without transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
