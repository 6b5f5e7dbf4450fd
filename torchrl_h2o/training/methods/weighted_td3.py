"""TD3 on real and simulated rows: TorchRL's loss, with simulated rows weighted by the dynamics ratio.

Only the Bellman error is weighted. The policy network is the same as for the other methods: TD3 trains its mean, and
the simulator is explored with its initial standard deviation. The policy is updated at every step, not at every second.
"""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate, TD3Loss

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import ImportanceWeightedLoss
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method
from torchrl_h2o.training.ratio import make_ratio_loss


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's TD3 loss, weighted row by row."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    ratio_loss = make_ratio_loss(cfg, observation_dim, action_spec.shape[-1], replay)
    estimator = ratio_loss.estimator
    td3 = TD3Loss(actor, qvalues, action_spec=action_spec, loss_function="l2", reduction="none")
    td3.make_value_estimator(gamma=cfg.gamma)
    loss = ImportanceWeightedLoss(td3, terms=["loss_qvalue"])

    def terms_of(batch: TensorDictBase, pairs: TensorDictBase) -> dict:
        ratio_losses = ratio_loss(pairs)
        return {**loss(estimator(batch)), **ratio_losses}

    losses, sizes = {"loss": loss, "ratio_loss": ratio_loss}, [cfg.batch_size, cfg.discriminator_batch_size]
    optimiser, targets = adam(loss, ratio_loss, lr=cfg.lr), SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, losses, optimiser, targets, replay, sizes, terms_of, one_graph=True)


WEIGHTED_TD3 = Method("weighted TD3", make_learner)
