"""RLPD: SAC on real and simulated rows in equal parts, which equals H2O+ without V and without the dynamics ratio."""

from omegaconf import DictConfig
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import H2OPlusLoss, MixedBellmanLoss
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Build SAC on both streams, with the target of Eq. (6)."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    loss = H2OPlusLoss(MixedBellmanLoss(actor, qvalues, mixing=0.0), target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)
    targets = SoftUpdate(loss, tau=cfg.tau)
    optimiser = adam(loss, lr=cfg.lr)
    return Learner(actor, {"loss": loss}, optimiser, targets, replay, [cfg.batch_size], loss, one_graph=True)


RLPD = Method("RLPD", make_learner)
