"""A training task: the real system, the imperfect simulator, and the source of the real data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import cycle, islice
from typing import Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.envs import Compose, DoubleToFloat, EnvBase, TransformedEnv

from torchrl_h2o.data.readers.sources import Source
from torchrl_h2o.effects import Effect, effect_from_dict, paper_gap
from torchrl_h2o.envs import BatchedMujocoEnv, DynamicsGap
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.real_data import first_seconds, read_real_data


@dataclass(frozen=True)
class Task:
    """One task in two versions: reality, and a simulator with a dynamics gap.

    A task is picklable, so a worker process can build its own environments from it. Report files are read when the
    task is built, not in the worker.

    Args:
        config: the resolved ``env`` section of a configuration: ``name``, ``make`` (target and arguments of one env),
            ``seconds_per_step``, and optionally ``batched``, ``reward``, ``columns``, ``behaviour``, ``recording``.
        reality: effects of the target dynamics P.
        simulator: effects of the simulator P̂, including the dynamics gap and the correction by ``mend``, if any.
        gap: name of the paper's dynamics gap in the simulator, or None.
        worlds: effects of each world in which transitions are collected, with ``mend=posterior``; empty if all have
            those of the simulator.
    """

    config: Mapping[str, Any]
    reality: tuple[Effect, ...]
    simulator: tuple[Effect, ...]
    gap: str | None = None
    worlds: tuple[tuple[Effect, ...], ...] = ()

    @classmethod
    def from_config(
        cls,
        env: DictConfig,
        *,
        gap: str | None = None,
        gap_strength: float | None = None,
    ) -> Task:
        """Builds a task from a configuration.

        Args:
            env: the ``env`` section of the configuration.
            gap: name of one of the paper's dynamics gaps, for the simulator.
            gap_strength: strength of the gap. Defaults to the paper's value.

        Raises:
            ValueError: for an unknown gap.
        """
        simulator = [instantiate(effect) for effect in env.simulator]
        if gap is not None:
            simulator.append(paper_gap(gap, gap_strength))
        reality = tuple(instantiate(effect) for effect in env.reality)
        config = cast(dict[str, Any], OmegaConf.to_container(env, resolve=True))
        return cls(config, reality, tuple(simulator), gap)

    def mended(self, found: Mapping[str, Any] | None) -> Task:
        """Returns the task with further effects in its simulator.

        Args:
            found: the entry ``mended`` of a run's configuration, see
                :func:`~torchrl_h2o.training.mending.find_missing_effects`: ``effects``, a list of effects as
                dictionaries, and ``worlds``, one such list for each world of the collection, or None for the same
                effects in all worlds. None leaves the task unchanged.
        """
        if found is None:
            return self
        plain: Any = OmegaConf.to_container(found) if isinstance(found, DictConfig) else found
        worlds = tuple((*self.simulator, *map(effect_from_dict, own)) for own in plain["worlds"] or ())
        return replace(self, simulator=(*self.simulator, *map(effect_from_dict, plain["effects"])), worlds=worlds)

    @property
    def name(self) -> str:
        """Name of the environment, for folders and tables."""
        return self.config["name"]

    @property
    def seconds_per_step(self) -> float:
        """Control step, in s."""
        return self.config["seconds_per_step"]

    @property
    def max_episode_steps(self) -> int | None:
        """Time limit of an episode in control steps; None if the configuration sets none."""
        return self.config["make"].get("max_episode_steps")

    def make_reality(
        self, num_worlds: int | None = None, preprocessing: Preprocessing | None = None, **kwargs
    ) -> EnvBase:
        """Builds an environment with the target dynamics P.

        Args:
            num_worlds: N for a batched env ``[N]``; None for one env ``[]``. A task that does not support batches
                gives one env ``[]`` in both cases.
            preprocessing: preprocessing of the observations; None leaves them in physical units.
            **kwargs: further arguments of the env, such as ``render_mode``.
        """
        return self._make(self.reality, num_worlds, preprocessing, kwargs)

    def make_simulator(
        self, num_worlds: int | None = None, preprocessing: Preprocessing | None = None, **kwargs
    ) -> EnvBase:
        """Builds an environment with the simulator's dynamics P̂; arguments as for :meth:`make_reality`."""
        return self._make(self.simulator, num_worlds, preprocessing, kwargs)

    def make_training_simulator(self, num_worlds: int, preprocessing: Preprocessing | None = None) -> EnvBase:
        """Builds the simulator in which transitions are collected and policies are tried.

        With ``mend=posterior`` each world has its own effects, and the next worlds repeat them if there are more worlds
        than draws; otherwise it equals :meth:`make_simulator`.
        """
        if not self.worlds:
            return self.make_simulator(num_worlds, preprocessing)
        effects = list(islice(cycle(self.worlds), num_worlds))
        env = BatchedMujocoEnv(instantiate(self.config["make"]), num_worlds, effects)
        return self._transformed(env, preprocessing)

    def read_real_data(self, data: Source, columns: str | None = None, seconds: float | None = None) -> TensorDictBase:
        """Reads the real transitions, ``[T]``, or the first ``seconds`` of them.

        See :func:`~torchrl_h2o.training.real_data.read_real_data` and
        :func:`~torchrl_h2o.training.real_data.first_seconds`.
        """
        real = read_real_data(self.config, self.make_reality(), data, columns)
        return real if seconds is None else first_seconds(real, seconds, self.seconds_per_step)

    def _make(
        self, effects: tuple[Effect, ...], num_worlds: int | None, preprocessing: Preprocessing | None, kwargs: dict
    ) -> EnvBase:
        env = TransformedEnv(instantiate(self.config["make"], **kwargs), DynamicsGap(*effects))
        if num_worlds is not None and self.config.get("batched", False):
            env = BatchedMujocoEnv(env, num_worlds)
        return self._transformed(env, preprocessing)

    @staticmethod
    def _transformed(env: EnvBase, preprocessing: Preprocessing | None) -> EnvBase:
        shown = [] if preprocessing is None else preprocessing.transforms()
        transforms: list[Any] = [DoubleToFloat(), *shown]  # TorchRL annotates each one as a list
        return TransformedEnv(env, Compose(*transforms))
