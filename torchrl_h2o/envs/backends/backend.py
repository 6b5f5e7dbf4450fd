"""The MuJoCo simulation inside a TorchRL env, alike for Gymnasium and dm_control.

What :class:`~torchrl_h2o.envs.DynamicsGap` needs of a simulation, and nothing that it does not.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_h2o.effects import Effect, ForceEffect, Pipeline, compile_model
from torchrl_h2o.effects.effect import Force
from torchrl_h2o.envs.episode import GapEpisodes

_SIZES = ("nq", "nv", "nu", "na", "nbody", "njnt", "ngeom", "nsite", "nsensor")


class MujocoBackend(ABC):
    """The simulation inside one env: its model, and how to put another one in.

    The gaps that are in a simulation, and their episodes, are remembered on the object that owns the
    model. A copy that is built anew, without the gaps' model, thus comes without the memory of them
    too; and all clones that TorchRL makes of a gap on one env live in the same episode.

    Args:
        owner: the object that owns model and data, and lives as long as they do.
        env: the TorchRL env around it.
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
        """The state in use."""

    @property
    @abstractmethod
    def control_step(self) -> float:
        """The time between two actions, in s."""

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """The specification of the model without any gap, parsed anew from its source."""

    @property
    @abstractmethod
    def source(self) -> str:
        """Where the model without any gap comes from, for error messages."""

    @property
    def written_at_reset(self) -> tuple[str, ...]:
        """The fields of the model that the task itself writes whenever an episode begins."""
        return ()

    @abstractmethod
    def load(self, model: mujoco.MjModel) -> None:
        """Puts a model and fresh data in, where the simulation and its renderers will use them."""

    @abstractmethod
    def push(self) -> None:
        """Makes every physics step from now on apply the forces of the present episodes."""

    @property
    def gaps(self) -> Mapping[object, Sequence[Effect]]:
        """What every gap that is in consists of, under what stands for the gap, in the order in which they came in."""
        return getattr(self.owner, "_dynamics_gaps", {})

    @property
    def episodes(self) -> GapEpisodes:
        """The present episode of every gap, under what stands for the gap."""
        return self.owner.__dict__.setdefault("_dynamics_gap_episodes", GapEpisodes())

    def apply(self, gap: object, on_env: Mapping[object, Sequence[Effect]]) -> None:
        """Puts a gap in, after those that are in already; does nothing if it is one of them.

        Args:
            gap: stands for the gap: the same object, the same gap.
            on_env: what each of the env's gaps consists of, this one included, the innermost first.
                Action and observation effects are passed over.

        Raises:
            ValueError: if the model has nothing that an effect could act on, or has a gap in it that
                the env has not. Nothing is changed.
        """
        applied = self.gaps
        if gap in applied:
            return
        if not applied.keys() <= on_env.keys():
            left = ", ".join(e.describe() for other in applied if other not in on_env for e in applied[other])
            raise ValueError(
                f"the simulator of {self.env} still has a gap in it that is not among the transforms "
                f"of this env ({left}), and would have both: make a new env for the new gap"
            )
        if not applied:
            self._check_source([effect for effects in on_env.values() for effect in effects])
        applied = {**applied, gap: tuple(on_env[gap])}
        pipeline = Pipeline(tuple(effect for effects in applied.values() for effect in effects))
        model = pipeline.compile(self.spec())
        self.check_sizes(model)
        model.vis.global_.offwidth = self.model.vis.global_.offwidth
        model.vis.global_.offheight = self.model.vis.global_.offheight
        self.load(model)
        if pipeline.of_kind(ForceEffect):
            self.push()
        self.owner._dynamics_gaps = applied

    def _check_source(self, effects: Sequence[Effect]) -> None:
        self.check_sizes(compile_model(self.spec()))
        # dm_control copies a model with its gaps, but not what we remember of them
        if not self._came_from([]) and not self._came_from(effects):
            raise ValueError(
                f"the model of {self.env} is not the one of {self.source}: it was changed after "
                "loading or built with arguments of its own, and a dynamics gap compiles its source "
                "anew. Make the change an effect of the gap"
            )

    def _came_from(self, effects: Sequence[Effect]) -> bool:
        """Whether the model in use is the one of the source with these effects in it."""
        model, source = self.model, compile_model(self.spec(), effects)
        source.vis.global_.offwidth = model.vis.global_.offwidth
        source.vis.global_.offheight = model.vis.global_.offheight
        for field in self.written_at_reset:
            getattr(source, field)[:] = getattr(model, field)
        return np.array_equal(_bytes(source), _bytes(model))

    def check_sizes(self, model: mujoco.MjModel) -> None:
        """Checks that a model has the joints, bodies and actuators of the one in use.

        Raises:
            ValueError: if it has not.
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
        """Takes physics steps one by one, each under the forces of the state that it starts from."""
        model, data, forces = self.model, self.data, self._forces()
        for _ in range(n_steps):
            # after a step, MuJoCo leaves the bodies where they were before it
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            others = data.qfrc_applied.copy()
            data.qfrc_applied += sum(force(data) for force in forces)
            step()
            data.qfrc_applied[:] = others

    def _forces(self) -> list[Force]:
        # in the order of the gaps, not of their resets, because a sum is rounded in its order
        episodes = self.episodes
        return [force for gap in self.gaps if gap in episodes for force in episodes[gap].effects.forces]


def _bytes(model: mujoco.MjModel) -> np.ndarray:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer


def base_env(env: EnvBase) -> EnvBase:
    """The env under all of an env's transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
