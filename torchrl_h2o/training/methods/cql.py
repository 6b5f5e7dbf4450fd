"""CQL on the real data alone: TorchRL's own loss. No simulator, so no gap touches it."""

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import Bounded, TensorSpec
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import CQLLoss, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """TorchRL's loss, on real rows alone.

    That loss draws its random actions from [-1, 1], so it is shown actions in units of their bounds: the policy that
    it trains shares the actor's network and acts within [-1, 1].
    """
    actor, qvalues = make_networks(cfg, observation_dim, action_spec)
    unit_spec = Bounded(-1.0, 1.0, action_spec.shape)
    unit_actor = ProbabilisticActor(
        actor.module[0], in_keys=["loc", "scale"], spec=unit_spec, distribution_class=TanhNormal
    )
    low, high = action_spec.space.low, action_spec.space.high

    loss = CQLLoss(unit_actor, qvalues, loss_function="l2", target_entropy=cfg.target_entropy, **cfg.cql)
    loss.make_value_estimator(gamma=cfg.gamma)

    def terms_of(batch: TensorDictBase) -> dict:
        batch["action"] = 2 * (batch["action"] - low) / (high - low) - 1
        losses = loss(batch)
        return losses.exclude("loss_actor_bc")  # the policy's loss where it is to copy the data: the other one's rival

    targets = SoftUpdate(loss, tau=cfg.tau)
    sizes = [(sum(cfg.batch_size), 0)]
    return Learner(
        actor,
        {"loss": loss},
        adam(loss, lr=cfg.lr),
        targets,
        replay,
        sizes,
        terms_of,
        pays_to_compile=False,  # thousands of actions an update: its time is in products
    )


CQL = Method("CQL", make_learner)
