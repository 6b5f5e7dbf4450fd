"""The wheel-legged robot: observation, reward, termination and motion."""

import math
import pickle

import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_h2o.envs.wheel_legged.env import (
    MAX_PITCH,
    OBSERVATIONS,
    WheelLeggedEnv,
    WheelLeggedMujocoEnv,
    reward,
)

TASKS = sorted(OBSERVATIONS)


@pytest.fixture
def robot():
    env = WheelLeggedMujocoEnv(reset_noise=0.0)
    env.reset(seed=0)
    yield env
    env.close()


def push(env, torque, steps):
    """Applies a torque for some control steps and returns the last observation."""
    for _ in range(steps):
        observation, *_ = env.step(np.array([torque], np.float32))
    return observation


def test_robot_weighs_twelve_kilograms(robot):
    assert robot.model.body_mass.sum() == pytest.approx(12.0)


def test_wheels_have_the_papers_radius(robot):
    for side in ("left", "right"):
        assert robot.model.geom(f"{side}_wheel").size[0] == pytest.approx(0.065)


def test_centre_of_mass_stands_straight_above_the_axle(robot):
    torso = robot.model.body("torso").id
    x, _, z = robot.data.xipos[torso] - robot.data.xpos[torso]
    assert x == pytest.approx(0.0, abs=1e-9)
    assert z == pytest.approx(0.15, abs=1e-3)


def test_control_step_is_five_milliseconds(robot):
    before = robot.data.time
    push(robot, 0.0, 1)
    assert robot.data.time - before == pytest.approx(0.005)


def test_action_is_one_torque_of_at_most_three(robot):
    assert robot.action_space.shape == (1,)
    assert robot.action_space.low == -3.0
    assert robot.action_space.high == 3.0


def test_both_wheels_get_the_torque(robot):
    push(robot, 1.5, 1)
    axle = robot.model.joint("axle").dofadr[0]
    assert robot.data.qfrc_actuator[axle] == pytest.approx(2 * 1.5)
    assert np.count_nonzero(robot.data.qfrc_actuator) == 1


@pytest.mark.parametrize("task", TASKS)
def test_observation_holds_the_state_in_the_papers_order(task):
    env = WheelLeggedMujocoEnv(task)
    env.reset(seed=0)
    state = {"theta": 0.1, "theta_dot": 0.2, "x": 0.3, "v": 0.4}
    env.set_state(
        np.array([state["x"], 0.0, state["theta"], 7.0]),
        np.array([state["v"], 0.0, state["theta_dot"], 8.0]),
    )
    expected = {
        "standing_still": (0.1, 0.2, 0.3, 0.4),
        "moving_forward": (0.4, 0.1, 0.2),
    }[task]
    np.testing.assert_allclose(env._get_obs(), expected, rtol=1e-6)
    assert expected == tuple(state[name] for name in OBSERVATIONS[task])


def test_velocity_is_that_of_the_displacement(robot):
    push(robot, 0.5, 10)
    x = robot.data.qpos[0]
    observation = push(robot, 0.5, 1)
    assert (observation[2] - x) / 0.005 == pytest.approx(observation[3], rel=0.05)


def test_wheels_roll_without_slipping(robot):
    observation = push(robot, 1.0, 20)
    _, _, pitch_rate, axle_rate = robot.data.qvel
    assert observation[3] == pytest.approx(0.065 * (axle_rate + pitch_rate), rel=0.01)


def test_forward_torque_drives_forward_and_pitches_the_body_back(robot):
    theta, theta_dot, x, v = push(robot, 1.0, 10)
    assert x > 0
    assert v > 0
    assert theta < 0
    assert theta_dot < 0


def test_response_to_torque_is_that_of_the_real_robots_log(robot):
    theta_dot, v = push(robot, 0.5, 4)[[1, 3]] / (0.5 * 0.02)
    assert v == pytest.approx(6.8, rel=0.05)  # m/s^2 per N·m
    assert theta_dot == pytest.approx(-34.0, rel=0.1)  # rad/s^2 per N·m


@pytest.mark.parametrize("lean", [0.01, -0.01])
def test_left_alone_it_falls_the_way_it_leans_as_fast_as_the_real_robot(robot, lean):
    qpos = robot.init_qpos.copy()
    qpos[2] = lean
    robot.set_state(qpos, robot.init_qvel)
    before = push(robot, 0.0, 40)[0]
    after = push(robot, 0.0, 10)[0]
    assert before / lean > 1
    assert math.log(after / before) / 0.05 == pytest.approx(9.0, rel=0.1)


def test_balanced_exactly_it_stands(robot):
    np.testing.assert_allclose(push(robot, 0.0, 40), np.zeros(4), atol=1e-5)


def test_reward_of_standing_still_is_the_papers():
    state = np.array([0.1, -0.5, 0.3, 0.7])
    by_hand = 30 - 0.3**2 - 0.7**2 - 0.1**2 - 0.5**2 - 2.0**2
    assert reward("standing_still", np.zeros(4), np.array([-2.0]), state) == pytest.approx(by_hand)


def test_reward_of_moving_forward_is_the_papers():
    state = np.array([0.5, 0.1, -0.5])
    by_hand = 15 - (0.5 - 0.2) ** 2 - 2.0**2
    assert reward("moving_forward", np.zeros(3), np.array([-2.0]), state) == pytest.approx(by_hand)


@pytest.mark.parametrize("task", TASKS)
def test_reward_of_a_batch_of_tensors_is_that_of_each_row(task):
    rng = np.random.default_rng(0)
    state = rng.normal(size=(5, len(OBSERVATIONS[task])))
    action = rng.uniform(-3, 3, size=(5, 1))
    batch = reward(task, torch.tensor(state), torch.tensor(action), torch.tensor(state))
    assert batch.shape == (5,)
    each = [reward(task, s, a, s) for s, a in zip(state, action, strict=True)]
    np.testing.assert_allclose(batch.numpy(), each)


@pytest.mark.parametrize("task", TASKS)
def test_env_pays_the_reward_of_the_state_reached_and_the_torque_asked_for(task):
    data = WheelLeggedEnv(task).rollout(5)
    expected = reward(task, data["observation"], data["action"], data["next", "observation"])
    torch.testing.assert_close(data["next", "reward"].squeeze(-1), expected)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("beyond", "lost"), [(-1e-3, False), (1e-3, True)])
def test_robot_is_lost_beyond_thirty_degrees(robot, sign, beyond, lost):
    qpos, qvel = robot.init_qpos.copy(), robot.init_qvel.copy()
    qpos[2] = sign * (math.pi / 6 + beyond)
    robot.set_state(qpos, qvel)
    robot.model.opt.timestep = 1e-6  # so that the pitch barely changes within the step
    *_, terminated, truncated, _ = robot.step(np.zeros(1, np.float32))
    assert terminated is lost
    assert truncated is False


def test_a_pitch_that_is_not_a_number_counts_as_lost(robot, monkeypatch):
    monkeypatch.setattr(robot, "do_simulation", lambda *_: robot.data.qpos.fill(np.nan))
    *_, terminated, _, _ = robot.step(np.zeros(1, np.float32))
    assert terminated


def test_episode_is_truncated_at_the_time_limit_and_not_terminated():
    data = WheelLeggedEnv(max_episode_steps=3).rollout(10)
    assert data["next", "truncated"].squeeze(-1).tolist() == [False, False, True]
    assert not data["next", "terminated"].any()


def test_default_episode_lasts_thirty_seconds():
    limit = WheelLeggedEnv()._env
    limit.reset(seed=0)
    limit._elapsed_steps = 5998
    robot = limit.unwrapped
    assert [limit.step(np.zeros(1, np.float32))[3] for _ in range(2)] == [False, True]
    assert 6000 * robot.dt == pytest.approx(30.0)


@pytest.mark.parametrize("task", TASKS)
def test_torchrl_env_keeps_its_specs(task):
    env = WheelLeggedEnv(task)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (len(OBSERVATIONS[task]),)
    assert env.observation_spec["observation"].dtype is torch.float32


def test_same_seed_gives_the_same_episode_and_another_seed_another():
    env = WheelLeggedEnv()

    def episode(seed):
        torch.manual_seed(seed)
        env.set_seed(seed)
        return env.rollout(20)["next", "observation"]

    first, again, other = episode(1), episode(1), episode(2)
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert not torch.equal(first[:5], other[:5])


def test_resets_spread_over_the_noise_asked_for():
    env = WheelLeggedMujocoEnv(reset_noise=0.1)
    env.reset(seed=0)
    theta, theta_dot, x, v = np.array([env.reset()[0] for _ in range(200)]).T
    for noisy in (theta, theta_dot):
        assert 0.09 < np.abs(noisy).max() <= 0.1
    assert not x.any()
    assert not v.any()


def test_copy_by_pickle_keeps_its_arguments():
    env = pickle.loads(pickle.dumps(WheelLeggedMujocoEnv("moving_forward", reset_noise=0.02)))
    assert (env.task, env.reset_noise) == ("moving_forward", 0.02)


def test_model_swapped_after_construction_is_the_one_simulated(robot):
    model = mujoco.MjModel.from_xml_path(robot.fullpath)
    model.opt.gravity[:] = 0.0
    robot.model, robot.data = model, mujoco.MjData(model)
    qpos = robot.init_qpos.copy()
    qpos[1:3] = 0.01, MAX_PITCH / 2
    robot.set_state(qpos, robot.init_qvel)
    assert push(robot, 0.0, 20)[0] == pytest.approx(MAX_PITCH / 2, abs=1e-6)


@pytest.mark.parametrize("make", [WheelLeggedMujocoEnv, WheelLeggedEnv])
def test_unknown_task_is_named_with_those_there_are(make):
    with pytest.raises(ValueError, match=r"'flying'.*standing_still, moving_forward"):
        make("flying")


def test_reward_of_an_unknown_task_is_an_error():
    with pytest.raises(ValueError, match="flying"):
        reward("flying", np.zeros(4), np.zeros(1), np.zeros(4))


@pytest.mark.parametrize("noise", [-0.1, math.pi / 6])
def test_reset_noise_that_starts_episodes_lost_is_an_error(noise):
    with pytest.raises(ValueError, match=f"reset_noise is {noise}"):
        WheelLeggedMujocoEnv(reset_noise=noise)


def test_rendering_shows_the_robot_from_the_side():
    env = WheelLeggedMujocoEnv(render_mode="rgb_array", width=160, height=120)
    try:
        env.reset(seed=0)
        upright = env.render()
    except Exception as error:  # each GL library raises its own error
        pytest.skip(f"no OpenGL to render with: {error}")
    assert upright.shape == (120, 160, 3)
    qpos = env.init_qpos.copy()
    qpos[2] = 0.5
    env.set_state(qpos, env.init_qvel)
    leaning = env.render()
    env.close()
    assert (upright != leaning).any(-1).mean() > 0.05
