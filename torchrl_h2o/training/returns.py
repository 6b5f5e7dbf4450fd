"""Returns of a policy over complete episodes with deterministic actions."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from math import inf

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

SEED = 1_000_000  # seed of the first episode of an evaluation


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns and lengths of episodes.

    Args:
        returns: one per episode, in units of the reward.
        lengths: one per episode, in control steps.
    """

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
    """Runs complete episodes without changing the state of torch's global generator.

    Args:
        env: one env ``[]``, which runs one episode after another, or N worlds ``[N]``, which run one episode each.
        policy: writes ``action``.
        episodes: number of episodes.
        seed: seed of the env and, during the evaluation, of torch.
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
    """Runs one episode in each world. Worlds that finish early keep stepping; their further rewards are ignored."""
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
    """Runs one episode to its end and returns its transitions, ``[T]``."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(max_steps, policy, auto_cast_to_device=False)


class BestPolicy:
    """Stores the actor's parameters from the evaluation with the highest return in the simulator.

    Args:
        actor: the trained policy; this class keeps a copy.
        simulator: the environment of the evaluations.
        episodes: number of episodes per evaluation.
    """

    def __init__(self, actor: torch.nn.Module, simulator: EnvBase, episodes: int) -> None:
        self.policy = deepcopy(actor)
        self.simulator, self.episodes = simulator, episodes

    def consider(self, actor: torch.nn.Module, rows: list[dict]) -> dict[str, float]:
        """Evaluates the actor in the simulator and stores it if no earlier evaluation was better.

        Args:
            actor: the policy with its current parameters.
            rows: metrics of the earlier evaluations, with ``return_sim``.

        Returns:
            The mean return, as ``return_sim``.
        """
        return_sim = evaluate(self.simulator, actor, self.episodes).mean
        if return_sim >= max((row["return_sim"] for row in rows), default=-inf):
            self.policy.load_state_dict(actor.state_dict())
        return {"return_sim": return_sim}
