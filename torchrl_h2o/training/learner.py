"""What is trained, and one update of it: batches, losses, a step of the optimiser, a step of the targets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import make_actor, make_qvalue, total_loss


@dataclass
class Learner:
    """Networks with their losses, their optimiser and their data.

    Args:
        actor: the policy.
        losses: by the name that a checkpoint gives them; each holds the networks that it trains.
        optimiser: of all of their parameters.
        targets: moves the target networks.
        replay: where batches come from.
        batch_sizes: of the batches of one update, (real, simulated) rows each.
        terms_of: takes these batches; returns terms named ``loss_*``, to be added up, and figures to be logged.
        figures: takes the same batches; returns what is logged beside the losses, and costs too much at every update.
        pays_to_compile: whether ``terms_of`` is faster once it is compiled.
        batches: those of the last update.
    """

    actor: torch.nn.Module
    losses: dict[str, LossModule]
    optimiser: torch.optim.Optimizer
    targets: SoftUpdate
    replay: HybridReplayBuffer
    batch_sizes: Sequence[tuple[int, int]]
    terms_of: Callable[..., dict[str, torch.Tensor]]
    figures: Callable[..., dict[str, float]] = lambda *batches: {}
    pays_to_compile: bool = True
    batches: list[TensorDictBase] = field(default_factory=list)

    def sample(self) -> list[TensorDictBase]:
        """The batches of one update."""
        return [self.replay.sample(size) for size in self.batch_sizes]

    def update(self) -> dict[str, torch.Tensor]:
        """One update of everything; returns what ``terms_of`` did."""
        self.batches = self.sample()
        losses = self.terms_of(*self.batches)
        self.optimiser.zero_grad()
        total_loss(losses).backward()
        self.optimiser.step()
        self.targets.step()
        return losses

    @property
    def simulates(self) -> bool:
        """Whether it needs a simulator: one that learns from real rows alone has no use for it."""
        return any(sim for _, sim in self.batch_sizes)

    @property
    def components(self) -> dict:
        """What a checkpoint holds."""
        return {"actor": self.actor, **self.losses, "optimiser": self.optimiser, "replay": self.replay}


def make_networks(
    cfg: DictConfig, observation_dim: int, action_spec: TensorSpec
) -> tuple[ProbabilisticActor, list[ValueOperator]]:
    """The policy and the two Q of the run's seed, the same for every method."""
    torch.manual_seed(cfg.seed)
    actor = make_actor(observation_dim, action_spec, cfg.num_cells)
    return actor, [make_qvalue(observation_dim, action_spec.shape[-1], cfg.num_cells) for _ in range(2)]


def adam(*losses: LossModule, lr: float) -> torch.optim.Adam:
    """One Adam for all parameters, in one pass over them."""
    return torch.optim.Adam([p for loss in losses for p in loss.parameters()], lr=lr, fused=True)
