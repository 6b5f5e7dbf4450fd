"""H2O+: the mixed Bellman update on both streams, with simulated rows weighted by the dynamics ratio."""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    ExpectileValueLoss,
    ExponentialValueLoss,
    H2OPlusLoss,
    InSampleValueLoss,
    MixedBellmanLoss,
    SparseValueLoss,
    make_value,
)
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method
from torchrl_h2o.training.ratio import make_ratio_loss


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Build H2O+: one loss, one optimiser, and two batches per update, the second for the discriminators."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    value_loss = make_value_loss(cfg, observation_dim)
    ratio_loss = make_ratio_loss(cfg, observation_dim, action_spec.shape[-1], replay, delayed=True)

    loss = H2OPlusLoss(
        MixedBellmanLoss(actor, qvalues, value_loss.value_network, mixing=cfg.mixing),
        value_loss=value_loss,
        ratio_loss=ratio_loss,
        weighted=cfg.ratio,
        target_entropy=cfg.target_entropy,
    )
    loss.make_value_estimator(gamma=cfg.gamma)

    def figures(batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, float]:
        return {"ratio_of_sim": float(ratio_loss.dynamics_ratio(batch)[~batch["real"]].mean())}

    return Learner(
        actor,
        {"loss": loss},
        adam(loss, lr=cfg.lr),
        SoftUpdate(loss, tau=cfg.tau),
        replay,
        [cfg.batch_size, cfg.discriminator_batch_size],
        loss,
        figures,
        one_graph=True,
    )


H2O_PLUS = Method("H2O+", make_learner)


def make_value_loss(cfg: DictConfig, observation_dim: int) -> InSampleValueLoss:
    """Build the value loss given by ``cfg.backbone``."""
    value_network = make_value(observation_dim, cfg.num_cells)
    if cfg.backbone == "expectile":
        return ExpectileValueLoss(value_network, cfg.expectile)
    loss = {"sparse": SparseValueLoss, "exponential": ExponentialValueLoss}[cfg.backbone]
    return loss(value_network, cfg.value_alpha)
