"""SAC in the simulator only, with TorchRL's loss: zero-shot transfer to reality."""

from omegaconf import DictConfig
from torchrl.data import TensorSpec
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's loss on batches of simulated rows."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    loss = SACLoss(actor, qvalues, loss_function="l2", target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)
    targets = SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, {"loss": loss}, adam(loss, lr=cfg.lr), targets, replay, [(0, sum(cfg.batch_size))], loss)


SAC = Method("SAC in the simulator", make_learner)
