"""The two environments of a run, from its configuration: reality, and the simulator with its dynamics gap."""

from collections.abc import Callable
from functools import partial

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import CatFrames, Compose, DoubleToFloat, EnvBase, ObservationNorm, TransformedEnv

from torchrl_h2o.effects import Effect, paper_gap
from torchrl_h2o.envs import BatchedMujocoEnv, DynamicsGap
from torchrl_h2o.residuals import Report


def make_reality(cfg: DictConfig, num_worlds: int | None = None, *, raw: bool = False, **kwargs) -> EnvBase:
    """The target dynamics P: the task with the effects of ``env.reality``.

    Args:
        cfg: the run's configuration.
        num_worlds: N, to be stepped at once, ``[N]``; one env, ``[]``, without it, or for a task that has no batch.
        raw: leave observations in their own units, whatever the run does.
        **kwargs: further arguments of the task, such as ``render_mode``.
    """
    return _make(cfg, [instantiate(effect) for effect in cfg.env.reality], num_worlds, raw, kwargs)


def make_simulator(cfg: DictConfig, num_worlds: int | None = None, *, raw: bool = False, **kwargs) -> EnvBase:
    """The imperfect simulator: the effects of ``env.simulator``, the paper's gap and what mends it, if these are named.

    Args:
        cfg, num_worlds, raw, **kwargs: as for :func:`make_reality`.

    Raises:
        ValueError: for a report that mends nothing.
        torchrl_h2o.data.DataError: for a report that cannot be read.
    """
    return _make(cfg, _simulator_effects(cfg), num_worlds, raw, kwargs)


def simulator_maker(cfg: DictConfig) -> Callable[[], EnvBase]:
    """What makes the run's simulator in another process or on another machine: what is in files here has been read."""
    return partial(_make, cfg, _simulator_effects(cfg), cfg.num_worlds, raw=False, kwargs={})


def _simulator_effects(cfg: DictConfig) -> list[Effect]:
    effects = [instantiate(effect) for effect in cfg.env.simulator]
    if cfg.gap is not None:
        effects.append(paper_gap(cfg.gap, cfg.gap_strength))
    if cfg.get("gap_fix") is not None:  # a run of an earlier version says nothing of it
        effects.extend(_missing_effects(cfg.gap_fix))
    return effects


def _missing_effects(report: str) -> tuple[Effect, ...]:
    """What a report of close_the_loop.py says that the simulator lacks."""
    effects = Report.load(report).effects
    if not effects:
        raise ValueError(f"gap_fix={report}: this report found nothing to put into the simulator; leave gap_fix out")
    return effects


def _make(cfg: DictConfig, effects: list, num_worlds: int | None, raw: bool, kwargs: dict) -> EnvBase:
    env = TransformedEnv(instantiate(cfg.env.make, **kwargs), DynamicsGap(*effects))
    if num_worlds is not None and cfg.env.get("batched", False):
        env = BatchedMujocoEnv(env, num_worlds)
    transforms = [DoubleToFloat()]
    if cfg.observation_norm is not None and not raw:
        transforms.append(ObservationNorm(**_norm(cfg), in_keys=["observation"], standard_normal=True))
    if _frames(cfg) > 1 and not raw:
        transforms.append(CatFrames(N=_frames(cfg), dim=-1, in_keys=["observation"]))
    return TransformedEnv(env, Compose(*transforms))


def measure_observation_norm(cfg: DictConfig, real: TensorDictBase) -> None:
    """Writes the real data's mean and standard deviation into the configuration, if the run normalises with them."""
    if cfg.normalise_observation and cfg.observation_norm is None:
        observation = real["observation"]
        scale = observation.std(0).clamp_min(1e-6)
        cfg.observation_norm = {"loc": observation.mean(0).tolist(), "scale": scale.tolist()}


def as_observed(cfg: DictConfig, real: TensorDictBase) -> TensorDictBase:
    """The real transitions as the learner sees them: observations normalised and stacked, rewards scaled."""
    real = real.copy()
    real["next"] = real["next"].copy().set("reward", learning_reward(cfg, real["next", "reward"]))
    if cfg.observation_norm is not None:
        norm = _norm(cfg)
        for part in (real, real["next"]):
            part["observation"] = (part["observation"] - norm["loc"]) / norm["scale"]
    if _frames(cfg) > 1:
        both = CatFrames(N=_frames(cfg), dim=-1, in_keys=["observation", ("next", "observation")])
        real = both.unfolding(real.refine_names("time"))
        real.names = None
    return real


def learning_reward(cfg: DictConfig, reward: torch.Tensor) -> torch.Tensor:
    """The reward that the losses see; what is reported is the task's own."""
    return cfg.reward_scale * (reward + cfg.reward_offset)


def _frames(cfg: DictConfig) -> int:
    return cfg.get("frames", 1)  # a run of an earlier version says nothing of it


def _norm(cfg: DictConfig) -> dict[str, torch.Tensor]:
    return {key: torch.tensor(list(value)) for key, value in cfg.observation_norm.items()}
