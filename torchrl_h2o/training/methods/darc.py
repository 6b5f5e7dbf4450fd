"""DARC: SAC in the simulator, with the log dynamics ratio added to the reward."""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import DynamicsRewardCorrection
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method
from torchrl_h2o.training.ratio import make_ratio_loss


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's SAC loss on simulated rows with corrected rewards; real data train the discriminators only."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    ratio_loss = make_ratio_loss(cfg, observation_dim, action_spec.shape[-1], replay)
    estimator = ratio_loss.estimator
    corrected = DynamicsRewardCorrection(estimator, scale=cfg.reward_scale, gamma=cfg.gamma)
    loss = SACLoss(actor, qvalues, loss_function="l2", target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)

    def terms_of(batch: TensorDictBase, pairs: TensorDictBase) -> dict:
        ratio_losses = ratio_loss(pairs)
        return {**loss(corrected(batch)), **ratio_losses}

    losses, sizes = {"loss": loss, "ratio_loss": ratio_loss}, [(0, sum(cfg.batch_size)), cfg.discriminator_batch_size]
    return Learner(
        actor, losses, adam(loss, ratio_loss, lr=cfg.lr), SoftUpdate(loss, tau=cfg.tau), replay, sizes, terms_of
    )


DARC = Method("DARC", make_learner)
