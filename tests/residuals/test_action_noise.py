"""Action noise is found where it makes the readings likelier, beside noise of the sensors, and not elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.pendulum import double_pendulum, pendulum, recorded
from torchrl_h2o.effects import ActionGain, ActionNoise, Gravity
from torchrl_h2o.envs import DynamicsGap
from torchrl_h2o.residuals import Measured, Simulation, Split
from torchrl_h2o.residuals.action_noise import add_action_noise, estimate_noise
from torchrl_h2o.residuals.blocks import Blocks
from torchrl_h2o.residuals.explanation import Explanation
from torchrl_h2o.residuals.record import Record
from torchrl_h2o.residuals.start_states import Steps


def noise_found(simulation, measured):
    """Standard deviation of the noise that is added, and the half-width of its interval."""
    parts = add_action_noise(simulation, measured, Explanation(())).parts
    return (parts[0].effect.std, np.ptp(parts[0].ci95["std"]) / 2.0) if parts else (0.0, 0.0)


@pytest.mark.parametrize(("std", "sensors"), [(0.05, 0.0), (0.05, 0.002), (0.3, 0.0), (0.3, 0.002), (0.3, 0.01)])
def test_noise_of_the_action_is_found_on_a_pendulum(std, sensors):
    simulation = pendulum()
    found, _ = noise_found(simulation, recorded(simulation.with_effects(ActionNoise(std)), 3000, noise=sensors))
    assert found == pytest.approx(std, rel=0.1)


@pytest.mark.slow
def test_noise_of_the_action_is_found_on_hopper():
    env = TransformedEnv(GymEnv("Hopper-v5"), DynamicsGap(ActionNoise(0.2)))
    torch.manual_seed(0)
    env.set_seed(0)
    data = env.rollout(1500, break_when_any_done=False)
    simulation = Simulation.from_env(GymEnv("Hopper-v5"))
    found, _ = noise_found(simulation, Measured.from_ted(data, simulation))
    assert found == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_sensors_is_not_taken_for_the_action_s(seed):
    assert noise_found(pendulum(), recorded(pendulum(), 3000, noise=0.01, seed=seed))[0] == 0.0


def test_a_missing_force_is_no_noise():
    """It makes successive errors alike."""
    assert noise_found(pendulum(), recorded(pendulum().with_effects(Gravity(1.1)), 3000, noise=0.002))[0] == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_a_force_too_small_to_be_found_is_no_noise(seed):
    """One per cent of sensor noise hides that its errors last, but noise of the actions does not explain them."""
    measured = recorded(pendulum().with_effects(Gravity(1.03)), 600, noise=0.01, seed=seed)
    assert noise_found(pendulum(), measured)[0] == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_noise_beside_a_force_too_small_to_be_found_is_found(seed):
    real = pendulum().with_effects(Gravity(1.03), ActionNoise(0.1))
    found, half_width = noise_found(pendulum(), recorded(real, 3000, noise=0.01, seed=seed))
    assert abs(found - 0.1) < max(0.03, half_width)


def test_steps_that_are_wrong_because_sensors_are_noisy_are_no_noise_of_the_actions():
    """A double pendulum is chaotic: noise of the sensors makes the linearised steps wrong."""
    assert noise_found(double_pendulum(), recorded(double_pendulum(), 3000, noise=0.005))[0] == 0.0


def test_without_noise_there_is_none():
    assert noise_found(pendulum(), recorded(pendulum(), 1000))[0] == 0.0


def test_the_simulator_s_own_noise_is_left_out():
    """The data have a standard deviation of 0.3; the simulator's own noise does not change the estimate."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionNoise(0.3)), 2000)
    plain, noisy = (estimate_noise(s, measured) for s in (simulation, simulation.with_effects(ActionNoise(1.0))))
    assert noisy.std == plain.std


@pytest.mark.parametrize("std", [0.02, 0.3])
def test_a_simulator_with_the_noise_of_the_data_lacks_none(std):
    simulation = pendulum().with_effects(ActionNoise(std))
    assert noise_found(simulation, recorded(simulation, 3000))[0] == 0.0


def test_derivatives_are_those_of_one_step():
    simulation, measured = pendulum(), recorded(pendulum(), 300)
    record = Record(simulation, measured)
    steps = Steps.of(record, Blocks.of(measured, Split.FIT, 16, 128))
    rows = steps.rows.ravel()
    states, action = record.states[0][rows], 0.999 * measured.action[rows]
    before, after = (simulation.rollout(states, a[:, None])[:, 0] for a in (measured.action[rows], action))
    expected = steps.by_action.reshape(-1, 2) * (action - measured.action[rows]) * record.spread
    np.testing.assert_allclose(after - before, expected, atol=1e-6)


def test_noise_is_that_before_the_control_range_cuts_it_off():
    """A third of the actions are at a limit of their range, so the model clamps part of the noise."""
    real = pendulum().with_effects(ActionGain(1.3), ActionNoise(0.5))
    simulation = pendulum().with_effects(ActionGain(1.3))
    std, half_width = noise_found(simulation, recorded(real, 4000))
    assert std == pytest.approx(0.5, rel=0.1)
    assert abs(std - 0.5) < 2.0 * half_width < 0.1


def test_what_scatters_more_than_the_actuators_do_is_not_theirs():
    """A velocity from a slow encoder has coloured noise, which neither noise model describes."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionNoise(0.2)), 3000)
    weak = replace(measured, action=0.1 * measured.action)
    assert noise_found(simulation, measured)[0] > 0.0
    assert noise_found(simulation.with_effects(ActionGain(10.0)), weak)[0] == 0.0
