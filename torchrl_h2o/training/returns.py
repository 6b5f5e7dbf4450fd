"""Returns of a policy over complete episodes with deterministic actions."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

SEED = 1_000_000  # seed of the first episode of an evaluation
TRIAL_SEED = 2_000_000  # the same in the simulator, to choose a policy by other start states than those that judge it


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns and lengths of episodes.

    Args:
        returns: one per episode, in units of the reward.
        lengths: one per episode, in control steps.
        mean_observation: ``[episodes, n]``, mean of each observed quantity over the episode's steps; None if it was
            not measured.
        max_observation: ``[episodes, n]``, largest absolute value of each observed quantity in the episode.
    """

    returns: list[float]
    lengths: list[int]
    mean_observation: torch.Tensor | None = None
    max_observation: torch.Tensor | None = None

    @property
    def mean(self) -> float:
        return float(torch.tensor(self.returns).mean())

    @property
    def std(self) -> float:
        return float(torch.tensor(self.returns).std(correction=0))

    @property
    def error(self) -> float:
        """Standard error of the mean return."""
        return self.std / len(self.returns) ** 0.5

    @property
    def lower_bound(self) -> float:
        """Mean return less two standard errors."""
        return self.mean - 2.0 * self.error

    @property
    def mean_length(self) -> float:
        return sum(self.lengths) / len(self.lengths)

    def metrics(self) -> dict[str, float]:
        """Metrics of an evaluation in ``reality`` during a training, by column of metrics.csv."""
        return {"return_real": self.mean, "return_real_std": self.std, "length_real": self.mean_length}

    def summary(self) -> dict:
        return {"mean": self.mean, "std": self.std, "episodes": len(self.returns), "mean_length": self.mean_length}

    def observed(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """Statistics of the observed quantities over all episodes.

        Args:
            names: name of each observed quantity, in the order of the observation.

        Returns:
            By name: ``mean``, the mean over episodes of the mean over an episode, and ``max_abs``, the largest absolute
            value in any episode, both in the quantity's unit. Empty if the observations were not measured.
        """
        if self.mean_observation is None or self.max_observation is None:
            return {}
        means, largest = self.mean_observation.mean(0).tolist(), self.max_observation.amax(0).tolist()
        return {
            name: {"mean": mean, "max_abs": largest_of_it}
            for name, mean, largest_of_it in zip(names, means, largest, strict=True)
        }


def evaluate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int,
    seed: int = SEED,
    physical: Callable[[torch.Tensor], torch.Tensor] | None = None,
) -> Evaluation:
    """Runs complete episodes without changing the state of torch's global CPU generator.

    Args:
        env: one env ``[]``, which runs one episode after another, or N worlds ``[N]``, which run one episode each.
        policy: writes ``action``.
        episodes: number of episodes.
        seed: seed of the env and, during the evaluation, of torch. Generators of other devices are seeded too, and
            their earlier states are not restored.
        physical: function from the env's observations to the quantities to measure, such as
            :meth:`~torchrl_h2o.training.preprocessing.Preprocessing.physical`; None measures nothing but returns.
    """
    parts: list[_Episodes] = []
    with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.manual_seed(seed)
        env.set_seed(seed)
        while sum(len(part.returns) for part in parts) < episodes:
            parts.append(_run_episodes(env, policy, physical))
    returns, lengths, total, largest = (torch.cat(column)[:episodes] for column in zip(*parts, strict=True))
    measured = {} if physical is None else {"mean_observation": total / lengths[:, None], "max_observation": largest}
    return Evaluation(returns.tolist(), lengths.tolist(), **measured)


class _Episodes(NamedTuple):
    """Returns and lengths of N episodes, ``[N]``, and sum and max |.| of their observations, ``[N, n]``."""

    returns: torch.Tensor
    lengths: torch.Tensor
    total: torch.Tensor
    largest: torch.Tensor


@torch.no_grad()
def _run_episodes(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    physical: Callable[[torch.Tensor], torch.Tensor] | None,
) -> _Episodes:
    """Runs one episode in each world. Worlds that finish early keep stepping; their further steps are ignored."""
    returns = torch.zeros(env.batch_size, dtype=torch.float64)
    lengths = torch.zeros(env.batch_size, dtype=torch.int64)
    running = torch.ones(env.batch_size, dtype=torch.bool)
    total = largest = returns.new_zeros((*env.batch_size, 1))
    current = env.reset()
    while running.any():
        stepped, current = env.step_and_maybe_reset(policy(current))
        returns += torch.where(running, stepped["next", "reward"].squeeze(-1), 0.0)
        if physical is not None:
            seen = torch.where(running[..., None], physical(stepped["next", "observation"]), 0.0)
            total, largest = total + seen, torch.maximum(largest, seen.abs())
        lengths += running
        running &= ~stepped["next", "done"].squeeze(-1)
    return _Episodes(returns.reshape(-1), lengths.reshape(-1), *(x.reshape(-1, x.shape[-1]) for x in (total, largest)))


@torch.no_grad()
def run_episode(env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], max_steps: int = 100_000):
    """Runs one episode to its end and returns its transitions, ``[T]``."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(max_steps, policy, auto_cast_to_device=False)


class BestPolicy:
    """Stores the actor's parameters from the evaluation in the simulator whose return has the highest lower bound.

    The first of them are those at which the training begins, so the policy is never worse there than these.

    Args:
        actor: the policy that is to be trained; this class keeps a copy.
    """

    def __init__(self, actor: torch.nn.Module) -> None:
        self.policy = deepcopy(actor)
        self._highest: float | None = None
        self._trained = self.policy

    def to_evaluate(self, actor: torch.nn.Module) -> list[torch.nn.Module]:
        """Copies the actor as it is now.

        Returns:
            The copy; at the first evaluation, also of a resumed training, the policy so far before it.
        """
        self._trained = deepcopy(actor)
        return [self._trained] if self._highest is not None else [self.policy, self._trained]

    def consider(self, evaluations: Sequence[Evaluation]) -> dict[str, float]:
        """Stores the copied actor if no earlier policy was better.

        Args:
            evaluations: in the simulator, of each policy of :meth:`to_evaluate`.

        Returns:
            Lower bounds of mean returns: the actor's, as ``return_trial``, and the best policy's, as ``return_kept``.
        """
        *first, return_trial = (evaluation.lower_bound for evaluation in evaluations)
        highest = first[0] if self._highest is None else self._highest
        if return_trial >= highest:
            self.policy.load_state_dict(self._trained.state_dict())
        self._highest = max(return_trial, highest)
        return {"return_trial": return_trial, "return_kept": self._highest}
