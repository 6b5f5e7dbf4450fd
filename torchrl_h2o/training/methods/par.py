r"""PAR: SAC on both streams, with simulated rewards lowered where the simulator departs from latent real dynamics.

.. math::
    \hat r=r-\beta\,\tfrac 1n\|g(f(s),a)-f(s')\|^2\ \text{of simulated rows},\qquad
    \min_\pi\tfrac{\nu}{\overline{|Q|}}E_{𝒟\cup B}[\alpha\log\pi(a|s)-Q(s,a)]+E_{𝒟}[(a_\pi-a)^2]

This is the variant for an online simulator and offline real data: the term that clones the actions of the real data
is that of ODRL's ``par_bc``. As in the other methods here, α is trained, and f and g are updated at every step; the
authors have α = 0.2 and one update of f and g in 200.

Source: J. Lyu, C. Bai, J. Yang, Z. Lu, X. Li, *Cross-Domain Policy Adaptation by Capturing Representation Mismatch*
(2024), arXiv 2405.15369; J. Lyu et al., *ODRL: A Benchmark for Off-Dynamics Reinforcement Learning* (2024), for β, ν
and the cloning term.
"""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    DynamicsRewardCorrection,
    H2OPlusLoss,
    MixedBellmanLoss,
    RepresentationLoss,
    make_representation_deviation,
)
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds SAC on both streams; real rows also train the encoders, whose deviation lowers simulated rewards."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    sizes = observation_dim, action_spec.shape[-1], cfg.num_cells
    deviation = make_representation_deviation(*sizes, next_observation=replay.next_observation)
    representation_loss = RepresentationLoss(deviation)
    corrected = DynamicsRewardCorrection(deviation, scale=-cfg.par.beta * cfg.reward_scale, gamma=cfg.gamma)
    bellman_loss = MixedBellmanLoss(actor, qvalues, mixing=0.0)
    loss = H2OPlusLoss(bellman_loss, cloning=cfg.par.cloning, target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)

    def terms_of(batch: TensorDictBase) -> dict[str, Tensor]:
        return {**representation_loss(batch), **loss(corrected(batch))}

    losses = {"loss": loss, "representation_loss": representation_loss}
    optimiser, targets = adam(loss, representation_loss, lr=cfg.lr), SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, losses, optimiser, targets, replay, [cfg.batch_size], terms_of, one_graph=True)


PAR = Method("PAR", make_learner)
