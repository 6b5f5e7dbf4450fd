"""DynamicsGap with negative noise, subtracted within one gap and across gaps."""

import copy

import numpy as np
import pytest
import torch
from torchrl.envs import Compose, GymEnv, MultiAction, TransformedEnv

from tests.envs.rollouts import CHEETAH, Executed, gapped, rollout
from torchrl_h2o.effects import ActionGain, ActionNoise, Gravity
from torchrl_h2o.envs import DynamicsGap, dynamics_gap


def in_one_gap(*effects) -> TransformedEnv:
    return gapped(*effects)


def in_gaps_behind_each_other(*effects) -> TransformedEnv:
    env = GymEnv(CHEETAH)
    for effect in effects:
        env = TransformedEnv(env, DynamicsGap(effect))
    return env


def in_envs_around_each_other(*effects) -> TransformedEnv:
    env = GymEnv(CHEETAH)
    for effect in effects:
        env = TransformedEnv(env, DynamicsGap(effect), auto_unwrap=False)
    return env


def in_one_compose(*effects) -> TransformedEnv:
    return TransformedEnv(GymEnv(CHEETAH), Compose(*map(DynamicsGap, effects)))


WAYS = [in_one_gap, in_gaps_behind_each_other, in_envs_around_each_other, in_one_compose]


@pytest.mark.parametrize("way", WAYS)
def test_noise_taken_off_whole_leaves_the_simulator_without(way):
    assert (rollout(way(ActionNoise(1.0), ActionNoise(-1.0))) == rollout(GymEnv(CHEETAH))).all()


@pytest.mark.parametrize("way", WAYS)
def test_noise_taken_off_in_part_leaves_the_difference_of_the_variances(way):
    assert (rollout(way(ActionNoise(1.0), ActionNoise(-0.6))) == rollout(gapped(ActionNoise(0.8)))).all()


def test_the_executed_action_scatters_by_what_is_left():
    base = Executed(CHEETAH)
    sim = TransformedEnv(base, dynamics_gap("joint_noise"))
    env = TransformedEnv(sim, DynamicsGap(Gravity(0.5), ActionNoise(-0.6)))
    data = rollout(env, 200)
    noise = torch.stack(base.executed[-200:]) - data["action"]
    assert noise.std() == pytest.approx(0.8, abs=0.05)


def test_a_gap_draws_as_ever_where_no_noise_is_taken_away():
    base = Executed(CHEETAH)
    sim = TransformedEnv(base, DynamicsGap(ActionNoise(0.5), Gravity(2.0)))
    env = TransformedEnv(sim, DynamicsGap(ActionGain(1.0), ActionNoise(2.0)))
    data = rollout(env, 5)
    torch.manual_seed(0)
    env.set_seed(0)
    inner, outer = (np.random.default_rng(int(torch.randint(2**63 - 1, ()))) for _ in range(2))
    for asked, executed in zip(data["action"], base.executed[-5:], strict=True):
        expected = asked.double().numpy() + 2.0 * outer.standard_normal(6)
        expected = torch.as_tensor(expected).to(asked.dtype).double().numpy() + 0.5 * inner.standard_normal(6)
        assert torch.equal(executed, torch.as_tensor(expected).to(asked.dtype))


def test_noise_put_on_later_is_taken_off_from_the_next_reset_on():
    env = gapped(ActionNoise(1.0))
    rollout(env, 3)
    env.append_transform(DynamicsGap(ActionNoise(-1.0)))
    assert (rollout(env) == rollout(GymEnv(CHEETAH))).all()


@pytest.mark.parametrize("way", WAYS)
def test_a_copied_env_has_no_noise_back(way):
    twin = copy.deepcopy(way(ActionNoise(1.0), ActionNoise(-1.0)))
    assert (rollout(twin) == rollout(GymEnv(CHEETAH))).all()


def test_a_transform_that_steps_the_env_itself_has_no_noise_back():
    base = Executed(CHEETAH)
    gaps = DynamicsGap(ActionNoise(1.0)), DynamicsGap(ActionNoise(-1.0))
    env = TransformedEnv(base, Compose(*gaps, MultiAction(stack_rewards=False)))
    commands = torch.arange(3.0)[:, None].expand(3, 6) / 10
    env.step(env.reset().set("action", commands))
    torch.testing.assert_close(torch.stack(base.executed[-3:]), commands)


# ------------------------------------------------------------------------------------ errors
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "effects",
    [
        [ActionNoise(-1.0)],
        [ActionNoise(0.5), ActionNoise(-1.0)],
        [ActionNoise(-1.0), ActionNoise(1.0)],
        [ActionNoise(1.0, actuators=(0,)), ActionNoise(-1.0)],
    ],
)
def test_noise_that_is_not_there_is_missed_when_the_gap_is_put_on(way, effects):
    with pytest.raises(ValueError, match=r"noise of standard deviation 1 taken off all actuators: .* put it behind"):
        way(*effects)


def test_a_gap_without_the_noise_that_it_takes_away_leaves_the_env_as_it_was():
    base, expected = GymEnv(CHEETAH), rollout(GymEnv(CHEETAH))
    with pytest.raises(ValueError, match="put it behind"):
        TransformedEnv(base, DynamicsGap(Gravity(2.0), ActionNoise(-1.0)))
    assert (rollout(base) == expected).all()
