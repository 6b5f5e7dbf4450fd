"""The policy that did best in the simulator so far, for ``keep=best_in_simulator``."""

from copy import deepcopy
from math import inf

import torch
from torchrl.envs import EnvBase

from torchrl_h2o.training.returns import evaluate


class BestPolicy:
    """Keeps the parameters of an actor at the evaluation with the highest return in the simulator.

    Args:
        actor: the policy that is trained; it is copied.
        simulator: the environment of the evaluations.
        episodes: number of episodes of an evaluation.
    """

    def __init__(self, actor: torch.nn.Module, simulator: EnvBase, episodes: int) -> None:
        self.policy = deepcopy(actor)
        self.simulator, self.episodes = simulator, episodes

    def consider(self, actor: torch.nn.Module, rows: list[dict]) -> dict[str, float]:
        """Evaluates the actor in the simulator and keeps it if no earlier evaluation was better.

        Args:
            actor: the policy as it is now.
            rows: metrics of the earlier evaluations, with ``return_sim``.

        Returns:
            The mean return, as ``return_sim``.
        """
        return_sim = evaluate(self.simulator, actor, self.episodes).mean
        if return_sim >= max((row["return_sim"] for row in rows), default=-inf):
            self.policy.load_state_dict(actor.state_dict())
        return {"return_sim": return_sim}
