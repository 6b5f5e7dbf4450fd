r"""DARA: IQL on both streams, with the clipped log dynamics ratio added to the reward of simulated rows.

.. math::
    \hat r=r+\eta\,\mathrm{clip}\Big(\log\frac{P(s'|s,a)}{\hat P(s'|s,a)},-10,10\Big)\ \text{of simulated rows}

The authors have offline data of both dynamics; here the simulated rows are those that the policy collects. The
expectations of IQL are those over all rows of a batch, as in ODRL's code.

Source: J. Liu, H. Zhang, D. Wang, *DARA: Dynamics-Aware Reward Augmentation in Offline Reinforcement Learning* (2022),
arXiv 2203.06662. η, the bound and IQL as the algorithm: J. Lyu et al., *ODRL: A Benchmark for Off-Dynamics
Reinforcement Learning* (2024).
"""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import DynamicsRewardCorrection
from torchrl_h2o.training.learner import Learner, adam
from torchrl_h2o.training.loop import Method
from torchrl_h2o.training.methods.iql import make_iql
from torchrl_h2o.training.ratio import make_ratio_loss


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's IQL loss on both streams; the discriminators correct the simulated rewards."""
    actor, loss, iql_terms = make_iql(cfg, observation_dim, action_spec, replay)
    ratio_loss = make_ratio_loss(cfg, observation_dim, action_spec.shape[-1], replay)
    scale = cfg.dara.eta * cfg.reward_scale
    corrected = DynamicsRewardCorrection(ratio_loss.estimator, scale, clip=cfg.dara.clip, gamma=cfg.gamma)

    def terms_of(batch: TensorDictBase, pairs: TensorDictBase) -> dict:
        ratio_losses = ratio_loss(pairs)
        return {**iql_terms(corrected(batch)), **ratio_losses}

    losses, sizes = {"loss": loss, "ratio_loss": ratio_loss}, [cfg.batch_size, cfg.discriminator_batch_size]
    optimiser, targets = adam(loss, ratio_loss, lr=cfg.lr), SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, losses, optimiser, targets, replay, sizes, terms_of)


DARA = Method("DARA", make_learner)
