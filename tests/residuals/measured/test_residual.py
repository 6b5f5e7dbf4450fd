"""Residuals are zero for data of the same simulator, also with effects of every kind put in."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.pendulum import pendulum, recorded, three_parts
from torchrl_h2o.effects import (
    ActionDelay,
    ActionNoise,
    BodyMass,
    Gravity,
    JointForce,
    ObservationBias,
    ObservationGain,
)
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller
from torchrl_h2o.envs.mujoco_model import find_backend
from torchrl_h2o.residuals import Measured, Simulation, residuals
from torchrl_h2o.residuals.measured.residual import executed_actions, start_states

STEPS = 60
CONTROL_STEP = {"HalfCheetah-v5": 0.05, "Hopper-v5": 0.008}


def of_every_kind(task, steps_late=2.0):
    """Effects of every kind. Hopper falls often, so a delay must not carry actions of one run into the next."""
    return (
        Gravity(1.3),
        BodyMass(1.5, bodies="torso"),
        ActionDelay(steps_late * CONTROL_STEP[task]),
        JointForce(0.4, joints="*foot*"),
        ObservationGain(0.8, entries=(1,)),
        ObservationBias(0.1, entries=(2,)),
    )


def rollout(env, seed=0):
    torch.manual_seed(seed)
    env.set_seed(seed)
    return env.rollout(STEPS, break_when_any_done=False)


def gapped(task, *effects):
    return TransformedEnv(GymEnv(task), DynamicsGap(*effects))


@pytest.mark.parametrize("horizon", [1, 5])
@pytest.mark.parametrize("steps_late", [None, 2.0, 1.4], ids=["plain", "effects of every kind", "late by a fraction"])
@pytest.mark.parametrize("task", list(CONTROL_STEP))
def test_data_of_the_very_same_simulator_leave_no_residual(task, steps_late, horizon):
    env = gapped(task, *(of_every_kind(task, steps_late) if steps_late else ()))
    simulation = Simulation.from_env(env)
    measured = Measured.from_ted(rollout(env), simulation)
    assert len(measured.runs) > 2 or task != "Hopper-v5"
    missed = np.abs(residuals(simulation, measured, measured.windows(horizon), horizon)).max((1, 2))
    # the env's actions are single precision, which causes rounding where they are interpolated
    assert np.median(missed) < (1e-6 if steps_late == 1.4 else 1e-9)
    # the env's solver starts from its last solution, which causes small differences in some contacts
    assert missed.max() < 1e-4


@pytest.mark.parametrize("missing", [type(effect) for effect in of_every_kind("Hopper-v5")])
def test_an_effect_of_any_kind_that_is_missing_leaves_a_residual(missing):
    env = gapped("Hopper-v5", *of_every_kind("Hopper-v5"))
    full = Simulation.from_env(env)
    measured = Measured.from_ted(rollout(env), full)
    without = replace(full, effects=tuple(e for e in full.effects if not isinstance(e, missing)))
    assert np.abs(residuals(without, measured, measured.windows(1))).max() > 1e-3


def exact_wheel_legged(*effects, steps=80):
    """Double-precision data of an env that observes in single precision, and its true states."""
    env = TransformedEnv(WheelLeggedEnv(), DynamicsGap(*effects)) if effects else WheelLeggedEnv()
    simulation = Simulation.from_env(env)
    data = find_backend(env).owner.data
    env.set_seed(0)
    torch.manual_seed(0)
    step, states, actions, controller = env.reset(), [], [], noisy_balance_controller()
    for _ in range(steps):
        states.append(np.concatenate([data.qpos, data.qvel]))
        step = controller(step)
        actions.append(step["action"].double().numpy())
        step = env.step(step)["next"].exclude("reward")
        assert not step["done"].any()
    states.append(np.concatenate([data.qpos, data.qvel]))
    states = np.array(states)
    observed = simulation.state_map.observations(states)
    rows = np.arange(steps)
    measured = Measured(
        observed[:-1],
        np.array(actions),
        observed[1:],
        run=0 * rows,
        time=rows * simulation.control_step,
        usable=rows >= 0,
        split=three_parts(steps),
        left_out={},
        source="wheel-legged robot",
    )
    return simulation, measured, states[:-1]


@pytest.mark.parametrize("effects", [(), (Gravity(1.1), ActionDelay(0.01))], ids=["plain", "with effects"])
def test_wheel_legged_robot_leaves_no_residual(effects):
    simulation, measured, states = exact_wheel_legged(*effects)
    starts = measured.windows(5)
    assert np.abs(residuals(simulation, measured, starts, 5, states=states)).max() < 1e-9


def test_hidden_coordinates_are_carried_along():
    """The wheels' depth in the floor is not observed; it is simulated from some rows before."""
    simulation, measured, _ = exact_wheel_legged()
    at_rest = simulation.state_map.states(measured.observation)
    starts = measured.windows(1)[20:]
    carried, unknown = (np.abs(residuals(simulation, measured, starts, states=x)).mean((0, 1)) for x in (None, at_rest))
    assert (carried < 0.02 * unknown).all()


def test_a_window_that_diverges_is_nan_and_spoils_no_other():
    simulation = pendulum()
    measured = recorded(simulation, 300)
    states = start_states(simulation, measured)
    states[20, 1] = 1e15
    missed = residuals(simulation, measured, np.array([10, 20, 30]), 4, states=states)
    assert np.isnan(missed[1]).all()
    assert np.abs(missed[[0, 2]]).max() < 1e-9


def test_random_effects_are_left_out_without_a_generator():
    simulation = pendulum()
    measured = recorded(simulation, 300)
    noisy = simulation.with_effects(ActionNoise(0.3))
    np.testing.assert_array_equal(executed_actions(noisy, measured), measured.action)
    scatter = executed_actions(noisy, measured, np.random.default_rng(0)) - measured.action
    assert scatter.std() == pytest.approx(0.3, rel=0.15)


def test_no_run_leaks_into_the_next():
    simulation = pendulum().with_effects(ActionDelay(0.04))
    measured = recorded(simulation, 300)
    cut = replace(measured, run=(np.arange(300) >= 100).astype(int))
    executed = executed_actions(simulation, cut)
    np.testing.assert_array_equal(executed[102:], measured.action[100:-2])
    assert not executed[[0, 1, 100, 101]].any()
