"""The balancing controller, recordings under it, and the effects of the robot's real dynamics."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.envs import CatTensors, DMControlEnv, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from torchrl_h2o.effects import BodyMass
from torchrl_h2o.envs import DynamicsGap, mujoco_model
from torchrl_h2o.envs.recording import record
from torchrl_h2o.envs.wheel_legged.balance_controller import BalanceController, noisy_balance_controller
from torchrl_h2o.envs.wheel_legged.env import OBSERVATIONS, WheelLeggedEnv

CONFIG = Path(__file__).parents[2] / "torchrl_h2o" / "config" / "env" / "wheel_legged.yaml"
TASKS = sorted(OBSERVATIONS)


def make(world, task="standing_still", **kwargs):
    """Returns the robot with the effects of `simulator` or `reality` in the configuration."""
    config = OmegaConf.load(CONFIG).env
    env = instantiate(config.make, task=task, **kwargs)
    return TransformedEnv(env, DynamicsGap(*(instantiate(effect) for effect in config[world])))


def observed(observation):
    return TensorDict({"observation": torch.as_tensor(observation, dtype=torch.float32)})


def test_torque_is_the_gains_times_the_state():
    gains = {"theta": 2.0, "theta_dot": 0.3, "x": 0.5, "v": 0.7}
    controller = BalanceController("standing_still", gains)
    action = controller(observed([0.1, -0.2, 0.3, 0.4]))["action"]
    by_hand = 2.0 * 0.1 + 0.3 * -0.2 + 0.5 * 0.3 + 0.7 * 0.4
    torch.testing.assert_close(action, torch.tensor([by_hand]))


def test_moving_forward_is_steered_towards_its_velocity():
    controller = BalanceController("moving_forward", {"v": 2.0})
    assert controller(observed([0.2, 0.0, 0.0]))["action"].item() == 0.0
    assert controller(observed([0.5, 0.0, 0.0]))["action"].item() == pytest.approx(0.6)


def test_torque_keeps_the_bounds_of_the_action():
    action = BalanceController()(observed([[9.0, 0, 0, 0], [-9.0, 0, 0, 0]]))["action"]
    assert action.tolist() == [[3.0], [-3.0]]


def test_unknown_gain_is_named_with_what_is_observed():
    with pytest.raises(ValueError, match=r"gains has x, but moving_forward observes only v"):
        BalanceController("moving_forward", {"x": 1.0})


def test_unknown_task_is_an_error():
    with pytest.raises(ValueError, match="flying"):
        BalanceController("flying")


@pytest.mark.parametrize(("name", "value"), [("noise_std", -1.0), ("noise_time", 0.001)])
def test_noise_that_cannot_be_is_an_error(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        noisy_balance_controller(**{name: value})


def test_noise_has_the_deviation_and_the_correlation_time_asked_for():
    still = dict.fromkeys(OBSERVATIONS["standing_still"], 0.0)
    policy = noisy_balance_controller(gains=still, noise_std=0.4, noise_time=0.05)
    torch.manual_seed(0)
    state = observed(torch.zeros(400, 4)).auto_batch_size_(1)
    state["is_init"] = torch.ones(400, 1, dtype=torch.bool)
    noise = []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(110):
            noise.append(policy(state)["action"].clone())
            state["is_init"] = torch.zeros(400, 1, dtype=torch.bool)
    settled, later = noise[-11], noise[-1]
    assert settled.std().item() == pytest.approx(0.4, rel=0.1)
    correlation = (settled * later).mean() / (settled.std() * later.std())
    assert correlation.item() == pytest.approx((1 - 0.1) ** 10, abs=0.15)


def test_without_exploration_the_noisy_controller_is_the_quiet_one():
    state = observed([0.1, 0.0, 0.2, 0.0])
    state["is_init"] = torch.ones(1, dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        noisy = noisy_balance_controller()(state.clone())["action"]
    torch.testing.assert_close(noisy, BalanceController()(state.clone())["action"])


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("world", ["simulator", "reality"])
def test_both_worlds_keep_their_specs(world, task):
    check_env_specs(make(world, task))


def test_simulator_is_the_model_as_it_stands_in_the_file():
    ours, file = mujoco_model(make("simulator")), mujoco_model(WheelLeggedEnv())
    for name in ("body_mass", "geom_friction", "geom_condim", "dof_frictionloss", "dof_damping"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(file, name))


def test_reality_changes_what_its_effects_say():
    real, nominal = mujoco_model(make("reality")), mujoco_model(WheelLeggedEnv())
    assert real.body("torso").mass == pytest.approx(1.2 * nominal.body("torso").mass)
    np.testing.assert_allclose(real.body("torso").inertia, 1.2 * nominal.body("torso").inertia, rtol=1e-9)
    assert real.body("wheels").mass == nominal.body("wheels").mass
    assert real.joint("axle").frictionloss > nominal.joint("axle").frictionloss
    assert real.geom("left_wheel").friction[2] > nominal.geom("left_wheel").friction[2]
    assert real.geom("floor").friction[2] == nominal.geom("floor").friction[2]


def test_reality_acts_late():
    env = make("reality", reset_noise=0.0)
    state, velocities = env.reset(), []
    for _ in range(5):
        state["action"] = torch.tensor([3.0])
        state = env.step(state)["next"]
        velocities.append(state["observation"][3].item())
    assert np.abs(velocities[:2]).max() < 1e-3
    assert velocities[2] > 0.01


def test_reality_slows_a_rolling_robot_down():
    def speed_after_rolling(world):
        env = make(world, reset_noise=0.0)
        env.reset()
        robot = env.base_env._env.unwrapped
        robot.set_state(robot.init_qpos, np.array([0.3, 0.0, 0.0, 0.3 / 0.065]))
        return robot.step(np.zeros(1, np.float32))[0][3]

    assert speed_after_rolling("simulator") == pytest.approx(0.3, abs=1e-3)
    assert speed_after_rolling("reality") < 0.3 - 0.005 * 0.5


@pytest.mark.parametrize("task", TASKS)
def test_controller_balances_in_reality_but_wanders(task):
    data = record(make("reality", task), noisy_balance_controller(task), 700, 0, progress=False)
    assert not data["next", "terminated"].any()
    spread = dict(zip(OBSERVATIONS[task], data["observation"].std(0).tolist(), strict=True))
    # the real robot's log has 0.047 rad, 0.52 rad/s and 0.19 m/s
    assert 0.03 < spread["theta"] < 0.1
    assert 0.3 < spread["theta_dot"] < 0.9
    assert 0.1 < spread["v"] < 0.4


def test_gains_that_are_best_in_the_simulator_alone_fall_in_reality():
    # the linear-quadratic regulator of the simulator's linearisation with costs of
    # theta^2 + 300 x^2 + 0.001 tau^2: high gains, optimal only without actuation delay
    stiff = {"theta": 207.6, "theta_dot": 36.0, "x": 428.5, "v": 164.0}
    for world, falls in (("simulator", False), ("reality", True)):
        data = record(make(world), BalanceController(gains=stiff), 200, 0, progress=False)
        assert data["next", "terminated"].any().item() is falls


def test_a_recording_leaves_the_state_of_torch_s_cpu_generator():
    before = torch.get_rng_state()
    record(WheelLeggedEnv(), noisy_balance_controller("standing_still"), 10, seed=0, progress=False)
    assert torch.equal(torch.get_rng_state(), before)


def test_recording_is_a_chain_of_transitions_broken_only_where_episodes_end():
    env = WheelLeggedEnv(max_episode_steps=20)
    data = record(env, BalanceController(), 50, seed=0, progress=False)
    assert data.batch_size == (50,)
    ends = data["next", "done"].squeeze(-1)
    assert ends.nonzero().squeeze(-1).tolist() == [19, 39, 49]
    following = data["observation"][1:][~ends[:-1]]
    torch.testing.assert_close(following, data["next", "observation"][:-1][~ends[:-1]])
    assert not data["done"].any()
    assert (data["next", "terminated"] ^ data["next", "truncated"])[ends].all()
    assert set(data.keys(True, True)) == {
        *("observation", "action", "done", "terminated", "truncated"),
        *(("next", key) for key in ("observation", "reward", "done", "terminated", "truncated")),
    }


def test_recording_is_repeated_by_its_seed_and_leaves_torchs_random_state():
    env, policy = make("reality"), noisy_balance_controller()
    recordings = []
    for state, seed in ((10, 3), (11, 3), (11, 4)):
        torch.manual_seed(state)
        before = torch.random.get_rng_state()
        recordings.append(record(env, policy, 60, seed, progress=False))
        assert torch.equal(before, torch.random.get_rng_state())
    first, again, other = recordings
    assert (first == again).all()
    assert not torch.equal(first["action"], other["action"])


def test_recording_that_ends_as_the_robot_falls_is_not_truncated():
    limp = BalanceController(gains=dict.fromkeys(OBSERVATIONS["standing_still"], 0.0))
    falls = record(WheelLeggedEnv(), limp, 300, 0, progress=False)["next", "terminated"]
    until_lost = int(falls.nonzero()[0, 0]) + 1
    last = record(WheelLeggedEnv(), limp, until_lost, 0, progress=False)["next"][-1]
    assert last["done"]
    assert last["terminated"]
    assert not last["truncated"]


def test_recording_leaves_the_callers_env_as_it_was():
    env = TransformedEnv(WheelLeggedEnv(), DynamicsGap(BodyMass(2.0, bodies="torso")))
    record(env, noisy_balance_controller(), 5, seed=0, progress=False)
    assert isinstance(env.transform, DynamicsGap)
    assert "is_init" not in env.reset().keys()
    assert mujoco_model(env).body("torso").mass == pytest.approx(2 * 10.8)


def test_recording_nothing_is_an_error():
    with pytest.raises(ValueError, match="num_transitions is 0"):
        record(WheelLeggedEnv(), BalanceController(), 0)
    with pytest.raises(ValueError, match="seed is 'a'; give an integer"):
        record(WheelLeggedEnv(), BalanceController(), 5, seed="a")


def test_recording_a_batch_of_envs_is_an_error():
    with pytest.raises(ValueError, match=r"batch of \(2,\)"):
        record(SerialEnv(2, lambda: GymEnv("InvertedPendulum-v5")), BalanceController(), 5)


def test_recording_names_the_remedy_for_an_env_without_observation_and_is_single_precision():
    def policy(state):
        return state.set("action", torch.zeros(6, dtype=torch.float64))

    env = TransformedEnv(DMControlEnv("cheetah", "run"))
    with pytest.raises(ValueError, match=r"no 'observation', but position, velocity.*CatTensors"):
        record(env, policy, 5, progress=False)
    env.append_transform(CatTensors(["position", "velocity"], out_key="observation"))
    data = record(env, policy, 5, progress=False)
    numbers = ("observation", "action", ("next", "observation"), ("next", "reward"))
    assert {data[key].dtype for key in numbers} == {torch.float32}
    assert {data[key].dtype for key in ("done", ("next", "terminated"))} == {torch.bool}
