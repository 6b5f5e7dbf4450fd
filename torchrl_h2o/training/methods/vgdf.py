r"""VGDF: SAC on both streams, with Q learning from the simulated rows that lead to the values of reality.

.. math::
    \min_Q E_{𝒟}[(Q-\mathcal TQ)^2]+E_B[\omega\,(Q-\mathcal TQ)^2],\qquad\omega=1(\Lambda>\Lambda_\xi)

Λ is the likelihood of the value of the simulated next state among the values to which an ensemble of models of reality
leads; see :class:`~torchrl_h2o.objectives.ValueGuidedFilter`. The policy explores the simulator itself, without the
authors' optimistic exploration policy. The models have the hidden layers of the other networks, are trained at every
step, and filter from the first one; the authors keep all rows in the first tenth of a training.

Source: K. Xu, C. Bai, X. Ma, D. Wang, B. Zhao, Z. Wang, X. Li, W. Li, *Cross-Domain Policy Adaptation via Value-Guided
Data Filtering* (2023), arXiv 2305.17625, Eqs. (5) to (7).
"""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import (
    DynamicsModelLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    ValueGuidedFilter,
    fit_change_scale,
    make_dynamics_model,
)
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds SAC on both streams; real rows also train the models, which choose the simulated rows for Q."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    following = replay.next_observation
    sizes = observation_dim, action_spec.shape[-1], cfg.num_cells
    dynamics_loss = DynamicsModelLoss(
        make_dynamics_model(*sizes, ensemble=cfg.vgdf.num_models),
        change_scale=fit_change_scale(replay.real[:], next_observation=following),
        next_observation=following,
    )
    bellman_loss = MixedBellmanLoss(actor, qvalues, mixing=0.0)
    loss = H2OPlusLoss(bellman_loss, target_entropy=cfg.target_entropy)
    loss.make_value_estimator(gamma=cfg.gamma)
    filtered = ValueGuidedFilter(bellman_loss, dynamics_loss, cfg.vgdf.share)

    def terms_of(batch: TensorDictBase) -> dict[str, Tensor]:
        return {**dynamics_loss(batch), **loss(filtered(batch))}

    def figures(batch: TensorDictBase) -> dict[str, float]:
        return {"value_proximity": float(filtered(batch.copy())["value_proximity"][~batch["real"]].median())}

    losses = {"loss": loss, "dynamics_loss": dynamics_loss}
    optimiser, targets = adam(loss, dynamics_loss, lr=cfg.lr), SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, losses, optimiser, targets, replay, [cfg.batch_size], terms_of, figures, one_graph=True)


VGDF = Method("VGDF", make_learner)
