"""CQL on the real data only, with TorchRL's loss, accelerated. The dynamics gap does not affect it."""

from typing import cast

from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.objectives import AcceleratedCQLLoss
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds the loss on batches of real rows.

    The loss draws its random actions from [-1, 1]. Actions are therefore scaled from their bounds to [-1, 1], and the
    loss trains a policy with that range which shares the actor's network.
    """
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    unit_spec = Bounded(-1.0, 1.0, action_spec.shape, device=action_spec.device)
    unit_space, space = cast(ContinuousBox, unit_spec.space), cast(ContinuousBox, action_spec.space)
    unit_actor = ProbabilisticActor(
        cast(TensorDictModule, actor.module[0]),
        in_keys=["loc", "scale"],
        spec=unit_spec,
        distribution_class=TanhNormal,
        # as tensors, because a CUDA graph cannot contain the copy of a number to the GPU
        distribution_kwargs={"low": unit_space.low, "high": unit_space.high},
    )
    low, high = space.low, space.high

    loss = AcceleratedCQLLoss(unit_actor, qvalues, loss_function="l2", target_entropy=cfg.target_entropy, **cfg.cql)
    loss.make_value_estimator(gamma=cfg.gamma)

    def terms_of(batch: TensorDictBase) -> dict:
        batch["action"] = 2 * (batch["action"] - low) / (high - low) - 1
        losses = loss(batch)
        return losses.exclude("loss_actor_bc")  # behaviour cloning, an alternative to loss_actor

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
        pays_to_compile=False,  # products over 30 actions per state take most of the time
    )


CQL = Method("CQL", make_learner)
