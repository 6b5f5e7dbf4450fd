"""DynamicsGap in the workers of batched envs and in collectors."""

from functools import partial

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymEnv, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_h2o.effects import ActionDelay, ActionNoise, Gravity, JointForce
from torchrl_h2o.envs import DynamicsGap, dynamics_gap, mujoco_model

GAP = DynamicsGap(Gravity(2.0), JointForce(1.0), ActionDelay(0.02), ActionNoise(0.1))


def make(gap: DynamicsGap | None = GAP) -> EnvBase:
    env = GymEnv("HalfCheetah-v5")
    return env if gap is None else TransformedEnv(env, gap.clone())


def rollout(env: EnvBase) -> torch.Tensor:
    torch.manual_seed(0)
    env.set_seed(0)
    env.reset()
    data = env.rollout(5)
    env.close()
    return data


def test_each_worker_of_a_serial_env_has_its_own_gap():
    env = SerialEnv(2, [make, partial(make, DynamicsGap(Gravity(0.5)))])
    env.rollout(3)
    gravity = [mujoco_model(worker).opt.gravity[2] for worker in env._envs]
    np.testing.assert_allclose(gravity, [2 * -9.81, 0.5 * -9.81])


@pytest.mark.slow
def test_parallel_workers_step_as_serial_ones_do():
    gap = DynamicsGap(Gravity(2.0), JointForce(1.0), ActionDelay(0.02))
    parallel = rollout(ParallelEnv(2, partial(make, gap)))
    serial = rollout(SerialEnv(2, partial(make, gap)))
    without = rollout(SerialEnv(2, partial(make, None)))
    torch.testing.assert_close(parallel["next", "observation"], serial["next", "observation"])
    assert (serial["next", "observation"] - without["next", "observation"]).abs().max() > 0.1


@pytest.mark.slow
def test_specs_hold_in_parallel_and_noise_differs_between_seeded_workers():
    env = ParallelEnv(2, partial(make, DynamicsGap(ActionNoise(1.0))))
    check_env_specs(env)
    torch.manual_seed(0)
    env.set_seed(0)
    reset = env.reset()
    still = env.step(reset.set("action", torch.zeros(2, 6)))
    env.close()
    # the control cost in the reward, -0.1·|a|², separates the noise from the differing initial states
    velocity = still["next", "observation"][:, 8] - reset["observation"][:, 8]
    assert (velocity[0] - velocity[1]).abs() > 0.05


def test_a_collector_collects_in_the_changed_simulator():
    env = make()
    collector = Collector(env, policy=None, frames_per_batch=20, total_frames=40)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert [batch.numel() for batch in batches] == [20, 20]
    assert batches[0]["action"].abs().max() <= 1


@pytest.mark.parametrize("batched", [SerialEnv, ParallelEnv])
def test_a_gap_around_a_batched_env_is_refused(batched):
    env = batched(2, partial(make, None))
    try:
        with pytest.raises(ValueError, match=r"is batched.*Put the gap inside each worker"):
            TransformedEnv(env, dynamics_gap("gravity"))
    finally:
        env.close(raise_if_closed=False)
