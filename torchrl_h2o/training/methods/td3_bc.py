r"""TD3+BC on the real data only, with TorchRL's loss. It uses no simulator, so the dynamics gap does not affect it.

The policy minimises :math:`-\lambda Q(s, \pi(s)) + (\pi(s) - a)^2` with :math:`\lambda = \alpha / \overline{|Q|}`. It
has the network of the other methods, of which the mean is trained, at every step. With ``td3_bc.critic_penalty``
above 0, and ``layer_norm``, it is ReBRAC: the target of Q is lowered by the distance between the policy's next action
and the one in the data, see :class:`~torchrl_h2o.objectives.ReBRACLoss`, and rows of the data after which no action is
known are left out.

Source: S. Fujimoto, S. S. Gu, *A Minimalist Approach to Offline Reinforcement Learning* (2021), arXiv 2106.06860,
Eqs. (3) and (5). D. Tarasov, V. Kurenkov, A. Nikulin, S. Kolesnikov, *Revisiting the Minimalist Approach to Offline
Reinforcement Learning* (2023), arXiv 2305.09836, Eqs. (3) and (4).
"""

from omegaconf import DictConfig
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer, with_next_actions
from torchrl_h2o.objectives import ReBRACLoss
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's loss on batches of real rows."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    if cfg.td3_bc.critic_penalty:
        rows, keys = with_next_actions(replay.real[:]), [*replay.keys, ("next", "action")]
        replay = HybridReplayBuffer(rows, sim_capacity=1, keys=keys, device=replay.device)
    loss = ReBRACLoss(actor, qvalues, action_spec=action_spec, loss_function="l2", **cfg.td3_bc)
    loss.make_value_estimator(gamma=cfg.gamma)
    loss.select_out_keys("loss_actor", "loss_qvalue", "bc_loss", "lmbd")  # the others are values of each row
    targets = SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, {"loss": loss}, adam(loss, lr=cfg.lr), targets, replay, [(sum(cfg.batch_size), 0)], loss)


TD3_BC = Method("TD3+BC", make_learner)
