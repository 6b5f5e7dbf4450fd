"""Evaluation of a policy: whole episodes with its deterministic actions."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns and lengths (steps) of some episodes."""

    returns: list[float]
    lengths: list[int]

    @property
    def mean(self) -> float:
        return float(torch.tensor(self.returns).mean())

    @property
    def std(self) -> float:
        return float(torch.tensor(self.returns).std(correction=0))

    @property
    def mean_length(self) -> float:
        return sum(self.lengths) / len(self.lengths)

    def summary(self) -> dict:
        return {"mean": self.mean, "std": self.std, "episodes": len(self.returns), "mean_length": self.mean_length}


def evaluate(
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], episodes: int, seed: int = 1_000_000
) -> Evaluation:
    """Runs whole episodes, the first from the given seed, without touching the run's own random streams."""
    returns, lengths = [], []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        env.set_seed(seed)
        for _ in range(episodes):
            episode = run_episode(env, policy)
            returns.append(float(episode["next", "reward"].sum()))
            lengths.append(len(episode))
    return Evaluation(returns, lengths)


@torch.no_grad()
def run_episode(env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], max_steps: int = 100_000):
    """One episode to its end, ``[T]``."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(max_steps, policy, auto_cast_to_device=False)
