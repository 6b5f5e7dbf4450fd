r"""TD3+BC on the real data only, with TorchRL's loss. It uses no simulator, so the dynamics gap does not affect it.

The policy minimises :math:`-\lambda Q(s, \pi(s)) + (\pi(s) - a)^2` with :math:`\lambda = \alpha / \overline{|Q|}`. It
has the network of the other methods, of which the mean is trained, at every step.

Source: S. Fujimoto, S. S. Gu, *A Minimalist Approach to Offline Reinforcement Learning* (2021), arXiv 2106.06860,
Eqs. (3) and (5).
"""

from omegaconf import DictConfig
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate, TD3BCLoss

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's loss on batches of real rows."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    loss = TD3BCLoss(actor, qvalues, action_spec=action_spec, loss_function="l2", **cfg.td3_bc)
    loss.make_value_estimator(gamma=cfg.gamma)
    loss.select_out_keys("loss_actor", "loss_qvalue", "bc_loss", "lmbd")  # the others are values of each row
    targets = SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, {"loss": loss}, adam(loss, lr=cfg.lr), targets, replay, [(sum(cfg.batch_size), 0)], loss)


TD3_BC = Method("TD3+BC", make_learner)
