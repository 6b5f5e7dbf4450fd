"""H2O+: the mixed Bellman update on both streams, simulated rows weighted by the dynamics ratio."""

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch.nn.functional import pad
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    InSampleValueLoss,
    SparseValueLoss,
    make_dynamics_ratio_estimator,
    make_value,
)
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


class H2OPlusTerms(torch.nn.Module):
    """What an update adds up: H2O+'s loss on a batch, and the discriminators' on pairs of their own."""

    def __init__(self, loss: H2OPlusLoss, ratio_loss: DynamicsRatioLoss, ratio: bool, num_real: int) -> None:
        super().__init__()
        self.loss, self.ratio_loss, self.ratio, self.num_real = loss, ratio_loss, ratio, num_real

    def forward(self, batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, torch.Tensor]:
        ratio_losses = self.ratio_loss(pairs)
        if self.ratio:
            of_simulated = self.ratio_loss.dynamics_ratio(batch[self.num_real :])  # Eq. (9)
            batch["dynamics_ratio"] = pad(of_simulated, (self.num_real, 0), value=1.0)
        return {**self.loss(batch), **ratio_losses}

    def draw_noise(
        self, batch: TensorDictBase, pairs: TensorDictBase, generator: torch.Generator | None = None
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """The noise of a forward, for the batch and for the pairs, drawn in the forward's order."""
        of_pairs = self.ratio_loss.draw_noise(pairs, generator)
        return self.loss.draw_noise(batch, generator), of_pairs


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """The method: real and simulated batches, one loss, one optimiser."""
    # Networks. Each is held by the loss that trains it.
    actor, qvalues = make_networks(cfg, observation_dim, action_spec)
    value_loss = make_value_loss(cfg, observation_dim)
    estimator = make_dynamics_ratio_estimator(observation_dim, action_spec.shape[-1], cfg.num_cells)

    # Losses. The discriminators have batches of their own, so their loss stands beside H2O+'s.
    num_real, _ = cfg.batch_size
    loss = H2OPlusLoss(
        actor, qvalues, value_loss, mixing=cfg.mixing, target_entropy=cfg.target_entropy, num_real=num_real
    )
    loss.make_value_estimator(gamma=cfg.gamma)
    ratio_loss = DynamicsRatioLoss(estimator, input_noise=cfg.input_noise)

    def figures(batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, float]:
        return {"ratio_of_sim": float(estimator(batch)["dynamics_ratio"][~batch["real"]].mean())}

    return Learner(
        actor,
        {"loss": loss, "ratio_loss": ratio_loss},
        adam(loss, ratio_loss, lr=cfg.lr),
        SoftUpdate(loss, tau=cfg.tau),
        replay,
        [cfg.batch_size, cfg.discriminator_batch_size],
        H2OPlusTerms(loss, ratio_loss, cfg.ratio, num_real),
        figures,
    )


H2O_PLUS = Method("H2O+", make_learner)


def make_value_loss(cfg: DictConfig, observation_dim: int) -> InSampleValueLoss:
    """The backbone: swapping it is one argument."""
    value_network = make_value(observation_dim, cfg.num_cells)
    if cfg.backbone == "expectile":
        return ExpectileValueLoss(value_network, cfg.expectile)
    if cfg.backbone == "sparse":
        return SparseValueLoss(value_network, cfg.value_alpha)
    if cfg.backbone == "exponential":
        return ExponentialValueLoss(value_network, cfg.value_alpha)
    raise ValueError(f"backbone={cfg.backbone}: choose expectile, sparse or exponential")
