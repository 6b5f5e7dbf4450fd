"""Evaluation of a policy: whole episodes with its deterministic actions, as many at once as the env has worlds."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

SEED = 1_000_000  # of a table's first episode


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
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], episodes: int, seed: int = SEED
) -> Evaluation:
    """Runs whole episodes, the first from the given seed, without touching the run's own random streams.

    Args:
        env: one env, ``[]``, whose episodes follow each other, or N worlds, ``[N]``, with an episode each.
        policy: writes ``action``.
        episodes: how many.
        seed: of the env.
    """
    returns, lengths = [], []
    with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.manual_seed(seed)
        env.set_seed(seed)
        while len(returns) < episodes:
            of_each, length_of_each = _run_episodes(env, policy)
            returns += of_each
            lengths += length_of_each
    return Evaluation(returns[:episodes], lengths[:episodes])


@torch.no_grad()
def _run_episodes(env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]) -> tuple[list[float], list[int]]:
    """An episode in each world: returns and lengths. Worlds that are done first go on, and count no more."""
    returns = torch.zeros(env.batch_size, dtype=torch.float64)
    lengths = torch.zeros(env.batch_size, dtype=torch.int64)
    running = torch.ones(env.batch_size, dtype=torch.bool)
    current = env.reset()
    while running.any():
        stepped, current = env.step_and_maybe_reset(policy(current))
        returns += torch.where(running, stepped["next", "reward"].squeeze(-1), 0.0)
        lengths += running
        running &= ~stepped["next", "done"].squeeze(-1)
    return returns.reshape(-1).tolist(), lengths.reshape(-1).tolist()


@torch.no_grad()
def run_episode(env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], max_steps: int = 100_000):
    """One episode to its end, ``[T]``."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(max_steps, policy, auto_cast_to_device=False)
