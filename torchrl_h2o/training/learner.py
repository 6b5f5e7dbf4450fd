"""A learner: networks, losses, optimiser and data, with a method that makes one update."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import TensorSpec
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer, PairedTransitions
from torchrl_h2o.objectives import make_actor, make_qvalue, total_loss
from torchrl_h2o.training.cuda_graph import as_cuda_graph
from torchrl_h2o.training.warm_start import begin, hold


@dataclass
class Learner:
    """Networks with their losses, their optimiser and their data.

    Args:
        actor: the policy.
        losses: loss modules by their names in a checkpoint; each contains the networks that it trains.
        optimiser: optimiser of the parameters of all losses.
        targets: updates the target networks.
        replay: the replay buffer.
        batch_sizes: (real, simulated) rows of each batch of one update.
        terms_of: maps these batches to terms named ``loss_*``, which are summed, and values to log.
        figures: maps the same batches to further values to log, computed at evaluations only.
        pays_to_compile: whether ``terms_of`` is faster when compiled.
        one_graph: whether ``terms_of`` is then compiled together with its gradients. TorchRL's SAC and IQL store
            tensors of their forward pass, which prevents that.
        pairs: source of the second batch, which trains the discriminators; the replay buffer if None.
        batches: the batches of the last update.

    Attributes:
        learn: changes all networks by means of some batches and returns the terms.
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
    one_graph: bool = False
    pairs: PairedTransitions | None = None
    batches: list[TensorDictBase] = field(default_factory=list)
    learn: Callable[..., dict[str, torch.Tensor]] = field(init=False)

    def __post_init__(self) -> None:
        self.learn = self._learn

    def use_cuda_graphs(self) -> None:
        """Makes the updates with a CUDA graph, all but the batches; needs ``fit_to_device`` before the first update."""
        self.learn = as_cuda_graph(self._learn, self.replay.device)

    def sample(self) -> list[TensorDictBase]:
        """Draws the batches of one update."""
        if self.pairs is None:
            return [self.replay.sample(size) for size in self.batch_sizes]
        first, second = self.batch_sizes
        return [self.replay.sample(first), self.pairs.sample(second)]

    def update(self, is_held: bool = False) -> dict[str, torch.Tensor]:
        """Makes one update of all networks, or of all but the policy, and returns the terms."""
        self.batches = self.sample()
        return self._learn(*self.batches, is_held=True) if is_held else self.learn(*self.batches)

    def _learn(self, *batches: TensorDictBase, is_held: bool = False) -> dict[str, torch.Tensor]:
        losses = self.terms_of(*batches)
        self.optimiser.zero_grad()
        total_loss(losses).backward()
        if is_held:
            hold(self.actor.parameters(), self.optimiser)
        self.optimiser.step()
        self.targets.step()
        return {name: loss.detach() for name, loss in losses.items()}

    @property
    def parameters(self) -> list[torch.nn.Parameter]:
        """The parameters that the optimiser changes."""
        return [parameter for group in self.optimiser.param_groups for parameter in group["params"]]

    @property
    def simulates(self) -> bool:
        """Whether any batch has simulated rows."""
        return any(sim for _, sim in self.batch_sizes)

    @property
    def trains_discriminators(self) -> bool:
        """Whether a second batch trains the discriminators of the dynamics ratio."""
        return len(self.batch_sizes) > 1

    @property
    def components(self) -> dict:
        """The contents of a checkpoint."""
        return {"actor": self.actor, **self.losses, "optimiser": self.optimiser, "replay": self.replay}


def make_networks(
    cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer
) -> tuple[ProbabilisticActor, list[TensorDictModule]]:
    """Builds the policy and the Q networks. Their initial weights depend on the run's seed, not on the method.

    With ``warm_start``, the policy is then that of the replay buffer's real rows, or of an earlier run.
    """
    torch.manual_seed(cfg.seed)
    actor = make_actor(observation_dim, action_spec, cfg.num_cells)
    options = {"layer_norm": cfg.layer_norm, "ensemble": cfg.num_qvalue_nets}
    qvalues = make_qvalue(observation_dim, action_spec.shape[-1], cfg.num_cells, **options)
    begin(cfg, actor, action_spec, replay)
    return actor, qvalues


def adam(*losses: LossModule, lr: float) -> torch.optim.Adam:
    """Builds one fused Adam optimiser for the parameters of all losses."""
    return torch.optim.Adam([p for loss in losses for p in loss.parameters()], lr=lr, fused=True)
