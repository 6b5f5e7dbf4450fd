"""Action noise is estimated from the residuals' covariance and separated from sensor noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionGain, ActionNoise
from torchrl_h2o.envs import DynamicsGap
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.measured.residual import start_states
from torchrl_h2o.residuals.noise.estimate import estimate_noise
from torchrl_h2o.residuals.noise.scatter import derivatives

LEVEL = 0.01


@pytest.mark.parametrize("std", [0.05, 0.3])
def test_noise_of_the_action_is_found_on_a_pendulum(std):
    simulation = pendulum()
    found = estimate_noise(simulation, recorded(simulation.with_effects(ActionNoise(std)), 3000))
    assert found.p_value < LEVEL
    assert found.action_std == pytest.approx(std, rel=0.1)


@pytest.mark.slow
def test_noise_of_the_action_is_found_on_hopper():
    env = TransformedEnv(GymEnv("Hopper-v5"), DynamicsGap(ActionNoise(0.2)))
    torch.manual_seed(0)
    env.set_seed(0)
    data = env.rollout(1500, break_when_any_done=False)
    simulation = Simulation.from_env(GymEnv("Hopper-v5"))
    found = estimate_noise(simulation, Measured.from_ted(data, simulation))
    assert found.p_value < LEVEL
    assert found.action_std == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_sensors_is_not_taken_for_the_action_s(seed):
    simulation = pendulum()
    assert estimate_noise(simulation, recorded(simulation, 3000, noise=0.01, seed=seed)).p_value > LEVEL


def test_noise_of_the_action_is_found_beside_that_of_the_sensors():
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionNoise(0.3)), 3000, noise=0.002)
    found = estimate_noise(simulation, measured)
    assert found.p_value < LEVEL
    assert found.action_std == pytest.approx(0.3, rel=0.1)


def test_without_noise_there_is_none():
    found = estimate_noise(pendulum(), recorded(pendulum(), 1000))
    assert found.p_value > LEVEL
    assert found.action_std < 1e-6


def test_the_simulator_s_own_noise_is_left_out():
    """The data have a standard deviation of 0.3; the simulator's own noise does not change the estimate."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionNoise(0.3)), 2000)
    plain, noisy = (estimate_noise(s, measured) for s in (simulation, simulation.with_effects(ActionNoise(1.0))))
    assert noisy.action_std == plain.action_std


def test_derivatives_are_those_of_one_step():
    simulation = pendulum()
    measured = recorded(simulation, 300)
    rows = measured.windows(1)
    states = start_states(simulation, measured)
    by_action, by_sensor = derivatives(simulation, measured, rows, states)
    moved, action = states + np.array([1e-3, -2e-3]), measured.action * 0.999
    before, after = (simulation.rollout(s, a[:, None])[:, 0] for s, a in ((states, measured.action), (moved, action)))
    expected = by_action[:, :, 0] * (action - measured.action) + by_sensor @ [1e-3, -2e-3]
    np.testing.assert_allclose(after - before, expected, atol=1e-6)


def test_noise_is_that_before_the_control_range_cuts_it_off():
    """A third of the actions are at a limit of their range, so the model clamps part of the noise."""
    real = pendulum().with_effects(ActionGain(1.3), ActionNoise(0.5))
    simulation = pendulum().with_effects(ActionGain(1.3))
    found = estimate_noise(simulation, recorded(real, 4000))
    assert found.p_value < LEVEL
    assert found.action_std == pytest.approx(0.5, rel=0.1)
    assert abs(found.action_std - 0.5) < 2.0 * found.half_width < 0.1


def test_what_scatters_more_than_the_actuators_do_is_not_theirs():
    """A velocity from a slow encoder has coloured noise, which neither noise model describes."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionNoise(0.2)), 3000)
    weak = replace(measured, action=0.1 * measured.action)
    weakened = simulation.with_effects(ActionGain(10.0))
    assert estimate_noise(simulation, measured).p_value < LEVEL
    assert estimate_noise(weakened, weak).p_value == 1.0
