"""Environments, preprocessing and replay buffer of a run, built from its complete configuration."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.task import Task


def task_of(cfg: DictConfig) -> Task:
    """Builds the task of a run; raises the errors of :meth:`Task.from_config`."""
    return unmended_task_of(cfg).mended(cfg.mended)


def unmended_task_of(cfg: DictConfig) -> Task:
    """Builds the same task without what the run has found with ``mend``."""
    return Task.from_config(cfg.env, gap=cfg.gap, gap_strength=cfg.gap_strength)


def preprocessing_of(cfg: DictConfig) -> Preprocessing:
    """Builds the preprocessing of a run, after :func:`measure_observation_norm` has completed the configuration."""
    norm = cfg.observation_norm
    return Preprocessing(
        loc=None if norm is None else tuple(norm.loc),
        scale=None if norm is None else tuple(norm.scale),
        frames=cfg.frames,
        action_history=cfg.action_history,
        reward_scale=cfg.reward_scale,
        reward_offset=cfg.reward_offset,
    )


def measure_observation_norm(cfg: DictConfig, real: TensorDictBase) -> None:
    """Writes mean and standard deviation of the real observations into the configuration, if the run normalises."""
    fitted = Preprocessing.fit(real, normalise=cfg.normalise_observation, norm=cfg.observation_norm)
    cfg.observation_norm = fitted.norm


def make_reality(cfg: DictConfig, num_worlds: int | None = None) -> EnvBase:
    """Builds reality with the run's preprocessing; ``num_worlds`` as for :meth:`Task.make_reality`."""
    return task_of(cfg).make_reality(num_worlds, preprocessing_of(cfg))


def make_simulator(cfg: DictConfig, num_worlds: int | None = None) -> EnvBase:
    """Builds the simulator with the run's preprocessing."""
    return task_of(cfg).make_simulator(num_worlds, preprocessing_of(cfg))


def simulator_maker(cfg: DictConfig) -> Callable[[], EnvBase]:
    """Picklable factory of the run's simulator for worker processes; report files are read in this process."""
    return partial(task_of(cfg).make_training_simulator, cfg.num_worlds, preprocessing_of(cfg))


def sim_capacity_of(cfg: DictConfig, num_real: int) -> int:
    """Largest number of simulated transitions in the replay buffer of a run with ``num_real`` real transitions."""
    return max(cfg.sim_capacity_min, int(cfg.sim_capacity * num_real))


def as_observed(cfg: DictConfig, real: TensorDictBase) -> TensorDictBase:
    """Applies the run's preprocessing to the real transitions."""
    return preprocessing_of(cfg).apply(real)


def make_replay(cfg: DictConfig, real: TensorDictBase) -> HybridReplayBuffer:
    """Builds the replay buffer of a run.

    Args:
        cfg: the run's configuration.
        real: the measured transitions, ``[T]``, in physical units; the buffer holds them with the run's preprocessing.
    """
    return HybridReplayBuffer(
        as_observed(cfg, real),
        sim_capacity=sim_capacity_of(cfg, len(real)),
        batch_size=cfg.batch_size,
        n_steps=cfg.n_steps,
        gamma=cfg.gamma,
        device=cfg.get("device", "cpu"),  # not an option of h2o_plus.py
    )


def keeps_best(cfg: DictConfig) -> bool:
    """Whether the run returns the policy that was best in the simulator instead of the last one."""
    return cfg.keep == "best_in_simulator"
