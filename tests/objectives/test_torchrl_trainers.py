"""TorchRL's own trainers run with H2OPlusLoss in the place of SACLoss."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, OfflineToOnlineReplayBuffer, ReplayBuffer, TensorDictReplayBuffer, Unbounded
from torchrl.envs import Compose, DoubleToFloat, GymEnv, Transform, TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import OfflineToOnlineTrainer, SACTrainer

from torchrl_h2o.objectives import (
    DynamicsRatioLoss,
    ExpectileValueLoss,
    H2OPlusLoss,
    MixedBellmanLoss,
    make_actor,
    make_dynamics_ratio_estimator,
    make_qvalue,
    make_value,
)

FRAMES, STEP_KEYS = 20, ("observation", "done", "terminated", "truncated", "reward", "real")


class MarkSimulated(Transform):
    """Marks every step of an environment as simulated."""

    def _call(self, next_tensordict):
        return next_tensordict.set("real", torch.zeros(1, dtype=torch.bool))

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        observation_spec["real"] = Unbounded((1,), dtype=torch.bool)
        return observation_spec


def setup():
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), Compose(DoubleToFloat(), MarkSimulated()))
    actor, value = make_actor(4, env.action_spec, (8,)), make_value(4, (8,))
    loss = H2OPlusLoss(
        MixedBellmanLoss(actor, make_qvalue(4, 1, (8,), ensemble=2), value),
        ExpectileValueLoss(value),
        DynamicsRatioLoss(make_dynamics_ratio_estimator(4, 1, (8,))),
    )
    return loss, {
        "collector": Collector(env, actor, frames_per_batch=FRAMES, total_frames=2 * FRAMES),
        "total_frames": 2 * FRAMES,
        "frame_skip": 1,
        "optim_steps_per_batch": 2,
        "loss_module": loss,
        "optimizer": torch.optim.Adam(loss.parameters(), 1e-3),
        "target_net_updater": SoftUpdate(loss, tau=0.01),
        "progress_bar": False,
        "enable_logging": False,
    }


def offline_to_online(real):
    offline = ReplayBuffer(storage=LazyTensorStorage(100))
    offline.extend(real)
    return OfflineToOnlineReplayBuffer(offline, online_capacity=100, batch_size=16)


def online(real):
    return TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=16)


@pytest.mark.parametrize(("trainer", "buffer"), [(SACTrainer, online), (OfflineToOnlineTrainer, offline_to_online)])
def test_a_trainer_of_torchrl_trains_every_network(trainer, buffer):
    loss, arguments = setup()
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), DoubleToFloat())
    real = env.rollout(FRAMES, break_when_any_done=False)
    real["real"] = torch.ones(FRAMES, 1, dtype=torch.bool)
    real = real.select("action", *STEP_KEYS, *(("next", key) for key in STEP_KEYS), strict=False)
    real["next", "real"] = real["real"].clone()
    before = {name: parameter.clone() for name, parameter in loss.named_parameters()}
    trainer(replay_buffer=buffer(real), **arguments).train()
    still = {name for name, parameter in loss.named_parameters() if (parameter == before[name]).all()}
    if buffer is online:  # without real rows V has no loss
        still = {name for name in still if "value_network_params" not in name.split(".")}
    assert not still
