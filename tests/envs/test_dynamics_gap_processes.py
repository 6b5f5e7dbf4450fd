"""Actions and observations of DynamicsGap: execution, reporting and repeatability."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import ObservationWrapper
from gymnasium.spaces import Box
from torchrl.envs import (
    ActionDiscretizer,
    CatTensors,
    Compose,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    MultiAction,
    ObservationNorm,
    RenameTransform,
    StepCounter,
    TransformedEnv,
)

from tests.envs.own_effects import ForgetfulNoise
from tests.envs.rollouts import CHEETAH, Executed, gapped, rollout
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    ActionNoise,
    Gravity,
    JointForce,
    ObservationBias,
    ObservationNoise,
)
from torchrl_h2o.envs import DynamicsGap, dynamics_gap


def test_the_simulator_executes_the_altered_action_and_the_data_keep_the_one_asked_for():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, DynamicsGap(ActionGain(3.0), ActionDelay(0.5 * 0.05)))
    asked = rollout(env, 5)["action"]
    assert env.action_spec.is_in(asked[0])
    previous = torch.cat([torch.zeros_like(asked[:1]), asked[:-1]])
    torch.testing.assert_close(torch.stack(base.executed[-5:]), 1.5 * asked + 1.5 * previous)


def test_noise_may_leave_the_bounds_and_mujoco_clamps():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, dynamics_gap("joint_noise"))
    data = rollout(env, 50)
    executed = torch.stack(base.executed[-50:])
    assert (executed.abs() > 1).any()
    assert data["action"].abs().max() <= 1
    noise = executed - data["action"]
    assert noise.std() == pytest.approx(1.0, abs=0.1)
    assert noise.mean() == pytest.approx(0.0, abs=0.1)


def test_randomness_repeats_with_torchs_generator():
    env = gapped(ActionNoise(1.0), ObservationNoise(0.1))
    first = rollout(env)
    assert (rollout(env) == first).all()
    env.set_seed(0)
    state = torch.get_rng_state()
    env.set_seed(0)
    second = env.rollout(5)
    env.set_seed(0)
    torch.set_rng_state(state)
    assert (env.rollout(5) == second).all()
    assert not (second == first[:5]).all()


def test_a_gap_without_randomness_draws_no_random_numbers():
    torch.manual_seed(0)
    env = gapped(Gravity(2.0), JointForce(1.0), ActionDelay(0.02), ObservationBias(1.0))
    state = torch.get_rng_state()
    env.reset()
    assert torch.equal(torch.get_rng_state(), state)


def test_a_delay_line_is_empty_again_after_a_reset():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, DynamicsGap(ActionDelay(0.05)))
    for _ in range(2):
        reset = env.reset()
        for expected in (0.0, 1.0):
            env.step(reset.set("action", torch.ones(6)))
            torch.testing.assert_close(base.executed[-1], torch.full((6,), expected))


def test_a_clone_has_a_delay_line_of_its_own():
    env = gapped(gap := ActionDelay(0.05))
    env.step(env.reset().set("action", torch.ones(6)))
    base = Executed(CHEETAH)
    twin = TransformedEnv(base, env.transform.clone())
    twin.step(base.reset().set("action", torch.ones(6)))  # without a reset, which would clear the delay line
    torch.testing.assert_close(base.executed[-1], torch.zeros(6))
    assert twin.transform.effects == (gap,)


def test_the_delay_knows_frames_that_torchrl_skips():
    base = Executed(CHEETAH, frame_skip=2)
    env = TransformedEnv(base, DynamicsGap(ActionDelay(0.05)))  # half a step of 0.1 s
    env.step(env.reset().set("action", torch.ones(6)))
    torch.testing.assert_close(base.executed[-1], torch.full((6,), 0.5))


def test_the_first_and_the_next_observations_are_altered():
    true, biased = rollout(GymEnv(CHEETAH)), rollout(gapped(ObservationBias(0.5, entries=(3,))))
    offset = torch.zeros(17, dtype=torch.float64)
    offset[3] = 0.5
    for key in ("observation", ("next", "observation")):
        torch.testing.assert_close(biased[key], true[key] + offset)


def test_a_transform_that_steps_the_env_itself_shares_the_episode():
    base = Executed(CHEETAH)
    env = TransformedEnv(base, Compose(DynamicsGap(ActionDelay(0.05)), MultiAction(stack_rewards=False)))
    state = env.reset()
    for start in (1.0, 4.0):
        base.executed = []
        commands = torch.arange(start, start + 3.0)
        state = env.step(state.set("action", commands[:, None].expand(3, 6) / 10))["next"]
        torch.testing.assert_close(torch.stack(base.executed)[:, 0], (commands - 1) / 10)


# ------------------------------------------------------------------------------------ errors
@pytest.mark.parametrize(
    "before",
    [
        lambda: ActionDiscretizer(num_intervals=3),
        lambda: ObservationNorm(0.0, 2.0, in_keys=["observation"]),
        lambda: RenameTransform(["observation"], ["state"]),
        lambda: CatTensors(["observation"], out_key="state"),
        StepCounter,
    ],
)
@pytest.mark.parametrize("effect", [ActionGain(2.0), ObservationBias(1.0)])
def test_an_effect_on_the_way_behind_another_transform_is_refused(before, effect):
    complaint = r"put it first: env\.insert_transform\(0, "
    with pytest.raises(ValueError, match=complaint):
        TransformedEnv(GymEnv(CHEETAH), Compose(before(), DynamicsGap(effect)))
    env = TransformedEnv(GymEnv(CHEETAH), before())
    with pytest.raises(ValueError, match=complaint):
        TransformedEnv(env, DynamicsGap(effect), auto_unwrap=False)


def test_a_gap_can_be_put_first_afterwards_but_nothing_before_it():
    env = TransformedEnv(GymEnv(CHEETAH), StepCounter())
    env.insert_transform(0, DynamicsGap(ObservationBias(0.5)))
    assert (env.reset()["observation"] - rollout(GymEnv(CHEETAH))["observation"][0]).min() > 0.0
    env.insert_transform(0, StepCounter(step_count_key="again"))
    with pytest.raises(ValueError, match="stands after StepCounter"):
        env.reset()


class Grey(ObservationWrapper):
    """Observes only integers, like an env with pixel observations."""

    def __init__(self):
        super().__init__(gymnasium.make(CHEETAH))
        self.observation_space = Box(0, 255, (2,), np.uint8)

    def observation(self, observation):
        return np.zeros(2, np.uint8)


def test_an_observation_effect_on_pixels_alone_is_refused():
    with pytest.raises(ValueError, match=r"no floating-point observations.*only observation; leave"):
        TransformedEnv(GymWrapper(Grey()), DynamicsGap(ObservationBias(1.0)))
    TransformedEnv(GymWrapper(Grey()), DynamicsGap(ObservationBias(), ActionGain(2.0))).rollout(2)


def test_an_effect_that_forgot_to_say_that_it_is_random_is_named():
    for effects in ([ForgetfulNoise(0.5)], [ActionNoise(0.5), ForgetfulNoise(0.5)]):
        with pytest.raises(
            ValueError, match=r"ForgetfulNoise\(std=0.5\) draws random numbers, but.*random: ClassVar\[bool\] = True"
        ):
            gapped(*effects)


def test_frames_skipped_outside_the_gap_are_refused():
    env = gapped(ActionDelay(0.05))
    env.append_transform(FrameSkipTransform(2))
    with pytest.raises(ValueError, match=r"FrameSkipTransform repeats actions.*frame_skip="):
        env.reset()
