"""H2O: SAC on both streams, weighted by the dynamics ratio, plus a term that lowers Q where the simulator is wrong."""

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch.nn.functional import pad
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    ConservativeLoss,
    DynamicsDivergence,
    H2OPlusLoss,
    MixedBellmanLoss,
)
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method
from torchrl_h2o.training.ratio import make_ratio_loss


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Build H2O, Eq. (1): a conservative term added to SAC on both streams."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    ratio_loss = make_ratio_loss(cfg, observation_dim, action_spec.shape[-1], replay)
    estimator = ratio_loss.estimator
    num_real, _ = cfg.batch_size
    spread = replay.real[:]["observation"].std(0)
    divergence = DynamicsDivergence(estimator, noise=spread, num_samples=cfg.h2o.num_samples)

    # The authors' target has no entropy term.
    no_bonus = TensorDictModule(torch.zeros_like, in_keys=["_log_prob"], out_keys=["exploration_bonus"])
    bellman_loss = MixedBellmanLoss(actor, qvalues, mixing=0.0, exploration=no_bonus)
    loss = ConservativeLoss(H2OPlusLoss(bellman_loss, target_entropy=cfg.target_entropy), alpha_c=cfg.h2o.alpha_c)
    loss.make_value_estimator(gamma=cfg.gamma)

    def terms_of(batch: TensorDictBase, pairs: TensorDictBase) -> dict[str, torch.Tensor]:
        ratio_losses = ratio_loss(pairs)
        simulated = divergence(estimator(batch[num_real:]))  # the ratio of Eq. (9), and ω before normalisation
        for key in ("dynamics_ratio", "dynamics_divergence"):
            batch[key] = pad(simulated[key], (num_real, 0), value=1.0)
        return {**loss(batch), **ratio_losses}

    losses, sizes = {"loss": loss, "ratio_loss": ratio_loss}, [cfg.batch_size, cfg.discriminator_batch_size]
    optimiser, targets = adam(loss, ratio_loss, lr=cfg.lr), SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, losses, optimiser, targets, replay, sizes, terms_of, one_graph=True)


H2O = Method("H2O", make_learner)
