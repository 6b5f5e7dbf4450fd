"""IQL on the real data only, with TorchRL's loss. It uses no simulator, so the dynamics gap does not affect it."""

from collections.abc import Callable

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.data import TensorSpec
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import IQLLoss, SoftUpdate

from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.data.multi_step import STEPS
from torchrl_h2o.objectives import make_value
from torchrl_h2o.training.learner import Learner, adam, make_networks
from torchrl_h2o.training.loop import Method


def make_iql(
    cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer
) -> tuple[ProbabilisticActor, IQLLoss, Callable[[TensorDictBase], TensorDictBase]]:
    """Builds the policy, TorchRL's loss, and a function that computes the loss of rows with one or several steps."""
    actor, qvalues = make_networks(cfg, observation_dim, action_spec, replay)
    value = make_value(observation_dim, cfg.num_cells)
    loss = IQLLoss(actor, qvalues, value, loss_function="l2", **cfg.iql)
    loss.make_value_estimator(gamma=cfg.gamma)
    # The loss keeps only the entries below "next" for its target, so the number of steps is moved there.
    loss.value_estimator.set_keys(steps_to_next_obs=("next", STEPS))

    def terms_of(batch: TensorDictBase) -> TensorDictBase:
        if (steps := batch.get(STEPS, None)) is not None:
            batch["next", STEPS] = steps
        return loss(batch)

    return actor, loss, terms_of


def make_learner(cfg: DictConfig, observation_dim: int, action_spec: TensorSpec, replay: HybridReplayBuffer) -> Learner:
    """Builds TorchRL's loss on batches of real rows."""
    actor, loss, terms_of = make_iql(cfg, observation_dim, action_spec, replay)
    targets = SoftUpdate(loss, tau=cfg.tau)
    return Learner(actor, {"loss": loss}, adam(loss, lr=cfg.lr), targets, replay, [(sum(cfg.batch_size), 0)], terms_of)


IQL = Method("IQL", make_learner)
