"""State estimates: closer to the truth than noisy readings, causal, and equal to readings that have no noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.residuals.pendulum import double_pendulum, pendulum
from tests.residuals.pendulum import recorded as recorded_pendulum
from torchrl_h2o.effects import ActionDelay, Gravity, JointFrictionLoss, ObservationGain
from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation, StateMap
from torchrl_h2o.residuals.estimated_states import estimate_states, sensor_noise
from torchrl_h2o.residuals.measured.residual import start_states

NOISE = np.array([0.005, 0.05, 0.001, 0.03])  # rad, rad/s, m, m/s


@pytest.fixture(scope="module")
def recorded():
    return record(WheelLeggedEnv(), noisy_balance_controller(), 800, seed=0)


@pytest.fixture(scope="module")
def simulation():
    return Simulation.from_env(WheelLeggedEnv())


def with_noise(measured, scale=1.0):
    noise = scale * NOISE * np.random.default_rng(0).standard_normal((len(measured) + 1, 4))
    return replace(measured, observation=measured.observation + noise[:-1], following=measured.following + noise[1:])


def error(simulation, states, measured):
    return np.sqrt(((simulation.state_map.observations(states) - measured.observation) ** 2).mean(0))


def test_estimates_are_far_nearer_to_the_truth_than_what_was_measured(simulation, recorded):
    true = Measured.from_ted(recorded, simulation)
    estimate = estimate_states(simulation, with_noise(true))
    assert (error(simulation, estimate, true) < 0.5 * NOISE).all()


def test_the_sensors_noise_is_found_beside_a_wrong_model(simulation, recorded):
    lacking = simulation.with_effects(JointFrictionLoss(0.3, joints="axle"))
    found = sensor_noise(lacking, with_noise(Measured.from_ted(recorded, simulation)))
    np.testing.assert_allclose(found, NOISE, rtol=0.25)


def test_a_wrong_model_does_not_make_estimates_worse_than_what_was_measured(simulation, recorded):
    lacking = simulation.with_effects(JointFrictionLoss(0.3, joints="axle"))
    true = Measured.from_ted(recorded, simulation)
    for scale in (0.1, 1.0):
        estimate = estimate_states(lacking, with_noise(true, scale))
        assert (error(simulation, estimate, true) < 1.1 * scale * NOISE).all()


def test_columns_that_were_estimated_from_others_have_the_noise_that_is_known_of_them(simulation, recorded):
    known = np.array([0.0, 0.2, 0.0, 0.0])
    measured = replace(with_noise(Measured.from_ted(recorded, simulation)), estimated_std=known)
    found = sensor_noise(simulation, measured)
    np.testing.assert_allclose(found, np.where(known > 0.0, known, NOISE), rtol=0.25)


@pytest.mark.parametrize("lacking", [(), (Gravity(1.05),)], ids=["right simulator", "wrong simulator"])
def test_the_sensors_noise_of_a_pendulum_is_found(lacking):
    measured, clean = (recorded_pendulum(pendulum().with_effects(*lacking), 3000, noise) for noise in (0.02, 0.0))
    np.testing.assert_allclose(sensor_noise(pendulum(), measured), 0.02 * clean.observation.std(0), rtol=0.25)


def test_readings_without_noise_have_none(simulation, recorded):
    assert sensor_noise(simulation, Measured.from_ted(recorded, simulation)) is None


def test_without_noise_the_measured_states_come_out(simulation, recorded):
    true = Measured.from_ted(recorded, simulation)
    lacking = simulation.with_effects(JointFrictionLoss(0.3, joints="axle"))
    assert (error(simulation, estimate_states(lacking, true), true) < 1e-3 * NOISE).all()


def test_unobserved_coordinates_follow_the_estimate(simulation, recorded):
    true = Measured.from_ted(recorded, simulation)
    states, exact = estimate_states(simulation, with_noise(true)), start_states(simulation, true)
    rolling = states[:, 4] / 0.065 - states[:, 6]
    of_rolling, of_estimate = (np.std((speed - exact[:, 7])[64:]) for speed in (rolling, states[:, 7]))
    assert of_estimate < 0.9 * of_rolling  # a wheel's inertia smooths the noise of the sensors
    assert np.abs(states[20:, 1] - states[400, 1]).max() < 1e-3  # and the wheels stay at the same depth in the floor


def test_sensor_and_action_effects_of_the_simulation_are_respected(simulation, recorded):
    true = Measured.from_ted(recorded, simulation)
    scaled = replace(
        true, observation=true.observation * [1.0, 0.7, 1.0, 1.0], following=true.following * [1.0, 0.7, 1.0, 1.0]
    )
    with_gain = simulation.with_effects(ObservationGain(0.7, entries=(1,)), ActionDelay(0.0))
    assert (error(simulation, estimate_states(with_gain, scaled), true) < 1e-3 * NOISE).all()


def test_later_rows_and_other_runs_do_not_change_an_estimate(simulation, recorded):
    """Beyond the noise levels, which come from the part for fits."""
    half = recorded[:400].clone()
    half["next", "truncated"][-1] = half["next", "done"][-1] = True
    noisy = with_noise(Measured.from_ted(torch.cat([half, recorded[400:]]), simulation, held_out=0.4))
    other = replace(noisy, observation=noisy.observation.copy(), following=noisy.following.copy())
    other.observation[701:] = other.following[700:-1] = noisy.observation[:700:-1]  # with the same spread
    first, second = (estimate_states(simulation, data) for data in (noisy, other))
    np.testing.assert_allclose(first[:701], second[:701], atol=1e-9)
    assert (np.abs(first[701:] - second[701:]).max(0) > 0.1).any()


def test_velocities_that_no_sensor_reads_are_estimated_in_any_rows():
    full = double_pendulum()
    noisy, clean = (recorded_pendulum(full, 1500, noise) for noise in (0.01, 0.0))
    names = StateMap.of_coordinates(("shoulder", "elbow"), ("rad", "rad"), (0, 1), num_states=4)
    simulation = Simulation(full.spec, full.frame_skip, replace(names, hidden=(2, 3)))
    positions = replace(noisy, observation=noisy.observation[:, :2], following=noisy.following[:, :2])
    rows = positions.reported_on(5)
    missed = estimate_states(simulation, positions, rows)[rows] - clean.observation[rows]
    spread = clean.observation[:, 2:].std(0)
    assert (np.sqrt((missed[:, 2:] ** 2).mean(0)) < 0.25 * spread).all()
