"""Reads the data of the paper's Figures 3 and 4 from run folders: motion in reality, states in the simulator."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_h2o.comparison.results_file import identity, recorded
from torchrl_h2o.envs.wheel_legged.env import OBSERVATIONS
from torchrl_h2o.training.checkpoint import checkpoint_file, load_checkpoint
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.environments import make_reality, make_replay, preprocessing_of, task_of
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.returns import SEED
from torchrl_h2o.training.trained_policy import load_policy

SHOWN = {"standing_still": "x", "moving_forward": "v"}
EVERY = 0.2  # s
EPISODES = 5  # the first of the episodes that the run's table averages
COMPARED = ("h2o", "h2o_plus")  # the methods whose simulated data the paper compares
BINS = (np.linspace(-0.55, 0.55, 56), np.linspace(-8.0, 8.0, 65))  # of pitch (rad) and pitch rate (rad/s)


def robot_results(runs: Path, told: pd.DataFrame) -> dict[str, dict[tuple[str, str], list[np.ndarray]]]:
    """Read the requested runs from their folders.

    Args:
        runs: folder of the group's runs.
        told: rows of the results file for the requested runs; other runs are ignored.

    Returns:
        By task and method a list of arrays, one per run: ``way``, trajectories ``[episodes, T]`` sampled every 0.2 s
        with NaN after a fall, and ``states``, histograms ``[pitch, pitch rate]`` (H2O and H2O+ only).
    """
    asked, found = recorded(told), {"way": defaultdict(list), "states": defaultdict(list)}
    for summary in sorted(runs.glob("*/summary.json")):
        cfg, folder = load_config(summary.parent), summary.parent
        if tuple(identity(cfg).values()) in asked:
            found["way"][cfg.env.make.task, cfg.method].append(ways(cfg, folder))
            if cfg.method in COMPARED:
                found["states"][cfg.env.make.task, cfg.method].append(counted(simulated_states(cfg, folder)))
    return {kind: dict(arrays) for kind, arrays in found.items()}


def ways(cfg: DictConfig, folder: Path) -> np.ndarray:
    """Roll out the policy in reality: position (m) or velocity (m/s), ``[episodes, T]``, NaN after a fall."""
    env = make_reality(cfg, EPISODES)
    with torch.random.fork_rng(devices=[]), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.manual_seed(SEED)
        env.set_seed(SEED)
        policy = load_policy(cfg, folder, METHODS[cfg.method].title)
        steps = env.rollout(cfg.env.make.max_episode_steps, policy, break_when_any_done=False)
    done = steps["next", "done"].squeeze(-1).long()
    first = done.cumsum(1) - done == 0  # up to and including the first end
    value = _in_units(cfg, steps["next", "observation"], (SHOWN[cfg.env.make.task],)).squeeze(-1)
    every = round(EVERY / cfg.env.seconds_per_step)
    return torch.where(first, value, torch.nan)[:, every - 1 :: every].float().numpy()


def simulated_states(cfg: DictConfig, folder: Path) -> np.ndarray:
    """Read pitch (rad) and pitch rate (rad/s) of the simulated transitions in the run's last checkpoint, ``[N, 2]``."""
    replay = make_replay(cfg, task_of(cfg).read_real_data(cfg.data, cfg.columns, cfg.data_seconds))
    load_checkpoint(checkpoint_file(folder, METHODS[cfg.method].title), {"replay": replay})
    return _in_units(cfg, replay.storage[:]["observation"], ("theta", "theta_dot")).numpy()


def _in_units(cfg: DictConfig, observation: torch.Tensor, wanted: Sequence[str]) -> torch.Tensor:
    """Select dimensions of the last frame of the learner's observations ``[*B, n]`` and undo their normalisation."""
    names = OBSERVATIONS[cfg.env.make.task]
    return preprocessing_of(cfg).physical(observation, len(names))[..., [names.index(name) for name in wanted]]


def counted(states: np.ndarray) -> np.ndarray:
    """Histogram of states ``[N, 2]`` over :data:`BINS`."""
    counts, *_ = np.histogram2d(states[:, 0], states[:, 1], bins=BINS)
    return counts.astype(np.int32)


def spread_entropy(counts: np.ndarray) -> float:
    """Entropy of a histogram, in nats. exp(entropy) equals the number of cells of a uniform histogram with it."""
    share = counts[counts > 0] / counts.sum()
    return float(-(share * np.log(share)).sum())
