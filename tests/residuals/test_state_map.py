"""State maps: conversion between observations and states, clipped sensors and hidden coordinates."""

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv

from torchrl_h2o.envs import WheelLeggedEnv
from torchrl_h2o.envs.mujoco_model import find_backend
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.simulation.state_map import StateMap, probe_gymnasium

TASKS = ["HalfCheetah-v5", "Walker2d-v5", "Hopper-v5", "InvertedPendulum-v5", "Swimmer-v5"]


def rollout(env, steps=40):
    torch.manual_seed(0)
    env.set_seed(0)
    return env.rollout(steps, break_when_any_done=False)


@pytest.mark.parametrize("task", TASKS)
def test_observations_become_states_and_back(task):
    env = GymEnv(task)
    state_map = Simulation.from_env(env).state_map
    observed = rollout(env, 20)["next", "observation"].double().numpy()
    states = state_map.states(observed)
    np.testing.assert_allclose(state_map.observations(states), observed, atol=1e-12)
    # the task reports the same observations at these states
    owner = find_backend(env).owner
    for state, expected in zip(states, observed, strict=True):
        owner.set_state(state[: owner.model.nq], state[owner.model.nq :])
        np.testing.assert_allclose(owner._get_obs(), expected, atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_probing_leaves_the_task_where_it_was(task):
    env = GymEnv(task)
    env.set_seed(0)
    env.reset()
    data = find_backend(env).owner.data
    before = data.qpos.copy(), data.qvel.copy()
    Simulation.from_env(env)
    np.testing.assert_array_equal(before[0], data.qpos)
    np.testing.assert_array_equal(before[1], data.qvel)


def test_names_and_units_are_those_of_the_joints():
    state_map = Simulation.from_env(GymEnv("HalfCheetah-v5")).state_map
    assert state_map.names[:3] == ("rootz", "rooty", "bthigh")
    assert state_map.names[8:10] == ("rootx_velocity", "rootz_velocity")
    assert state_map.units[:2] == ("m", "rad")
    assert state_map.units[8:11] == ("m/s", "m/s", "rad/s")


@pytest.mark.parametrize(("task", "first"), [("Walker2d-v5", 8), ("Hopper-v5", 5)])
def test_velocities_clipped_at_ten_are_found(task, first):
    state_map = Simulation.from_env(GymEnv(task)).state_map
    observed = np.zeros((5, len(state_map.names)))
    observed[1, first], observed[2, -1], observed[3, first] = 10.0, -10.0, 9.99
    observed[4, first - 1] = 10.0  # an angle, which is not clipped
    assert state_map.clipped(observed).tolist() == [False, True, True, False, False]


def test_without_clipping_no_value_is_too_large():
    state_map = Simulation.from_env(GymEnv("HalfCheetah-v5")).state_map
    assert not state_map.clipped(1e6 * np.ones((1, 17))).any()


def test_clipped_rows_are_left_out_and_counted():
    env = GymEnv("Hopper-v5")
    data = rollout(env)
    data["next", "observation"][5, -1] = 10.0
    data["observation"][6] = data["next", "observation"][5]
    measured = Measured.from_ted(data, Simulation.from_env(env))
    assert np.flatnonzero(~measured.usable).tolist() == [5, 6]
    assert list(measured.left_out.values()) == [2]


@pytest.mark.parametrize("task", ["Reacher-v5", "InvertedDoublePendulum-v5"])
def test_an_observation_that_is_no_coordinate_is_refused(task):
    with pytest.raises(ValueError, match=r"does not consist of single coordinates.*StateMap of your own"):
        Simulation.from_env(GymEnv(task))


def test_an_observation_that_mixes_coordinates_is_refused():
    task = find_backend(GymEnv("InvertedPendulum-v5")).owner
    task._get_obs = lambda: np.array([task.data.qpos.sum(), *task.data.qvel])
    with pytest.raises(ValueError, match="does not consist of single coordinates"):
        probe_gymnasium(task, np.random.default_rng(0))


def test_axle_follows_from_velocity_and_pitch_rate():
    """The wheels, of 0.065 m radius, roll without slip and turn relative to the body."""
    state_map = Simulation.from_env(WheelLeggedEnv()).state_map
    velocity, pitch_velocity = 0.4, 1.5
    observed = np.zeros(4)
    observed[state_map.names.index("x_velocity")] = velocity
    observed[state_map.names.index("pitch_velocity")] = pitch_velocity
    axle_velocity = state_map.states(observed)[7]
    assert axle_velocity == pytest.approx(velocity / 0.065 - pitch_velocity)


def test_hidden_coordinates_are_those_that_matter():
    """Hidden are z and its velocity, the depth of the wheels in the floor, and the speed of the wheels.

    The rolled distance is not: no later observation depends on it.
    """
    assert Simulation.from_env(WheelLeggedEnv()).state_map.hidden == (1, 5, 7)


@pytest.mark.parametrize("task", ["HalfCheetah-v5", "Walker2d-v5", "Swimmer-v5"])
def test_a_coordinate_that_changes_nothing_is_not_hidden(task):
    """The unobserved distance affects no later observation."""
    assert Simulation.from_env(GymEnv(task)).state_map.hidden == ()


def test_a_map_of_coordinates_keeps_their_order_and_leaves_the_rest_at_rest():
    state_map = StateMap.of_coordinates(("rate", "angle"), ("rad/s", "rad"), (3, 1), num_states=4)
    states = state_map.states(np.array([[2.0, 0.5]]))
    np.testing.assert_array_equal(states, [[0.0, 0.5, 0.0, 2.0]])
    np.testing.assert_array_equal(state_map.observations(states), [[2.0, 0.5]])
