"""Errors several steps ahead, and the linear predictor for comparison."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import three_parts
from torchrl_h2o.effects import Gravity
from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation, Split
from torchrl_h2o.residuals.judge.error_ahead import horizon_errors, linear_floor


@pytest.fixture(scope="module")
def simulation():
    return Simulation.from_env(WheelLeggedEnv())


@pytest.fixture(scope="module")
def measured(simulation):
    return Measured.from_ted(record(WheelLeggedEnv(), noisy_balance_controller(), 600, seed=0), simulation)


def linear_system(rows=500, noise=0.0):
    """x' = 0.9 x + 0.5 u, observed with noise."""
    rng = np.random.default_rng(0)
    action, x = rng.standard_normal((rows, 1)), np.zeros((rows + 1, 1))
    for t in range(rows):
        x[t + 1] = 0.9 * x[t] + 0.5 * action[t]
    x = x + noise * rng.standard_normal(x.shape)
    return Measured(
        x[:-1],
        action,
        x[1:],
        np.zeros(rows, int),
        0.01 * np.arange(rows),
        np.ones(rows, bool),
        three_parts(rows),
        {},
        "test",
    )


def test_the_right_simulation_has_no_error_and_a_wrong_one_has_more_further_ahead(simulation, measured):
    right = horizon_errors(simulation, measured, [1, 10])
    wrong = horizon_errors(simulation.with_effects(Gravity(1.2)), measured, [1, 10])
    assert max(error.rmse.max() for error in right) < 1e-3
    assert (wrong[1].rmse[:2] > 3.0 * wrong[0].rmse[:2]).all()


def test_only_held_out_windows_are_judged(simulation, measured):
    spoilt = replace(measured, following=measured.following + ~measured.held_out[:, None] * 1.0)
    assert horizon_errors(simulation, spoilt, [5])[0].rmse.max() < 1e-3
    assert horizon_errors(simulation, spoilt, [5], split=Split.FIT)[0].rmse.max() > 0.5


def test_states_given_are_started_from(simulation, measured):
    states = np.zeros((len(measured), 8))
    assert horizon_errors(simulation, measured, [5], states=states)[0].rmse.max() > 0.01


def test_rmse_and_median_are_those_of_the_last_step(simulation, measured):
    shifted = replace(measured, following=measured.following + np.array([0.3, 0.0, 0.0, 0.0]))
    error = horizon_errors(simulation, shifted, [5])[0]
    assert error.rmse[0] == pytest.approx(0.3, rel=1e-2)
    assert error.median[0] == pytest.approx(0.3, rel=1e-2)
    assert error.windows == 150 - 5 + 1


def test_a_horizon_longer_than_the_data_has_no_figures(simulation, measured):
    error = horizon_errors(simulation, measured, [500])[0]
    assert error.windows == 0
    assert np.isnan(error.rmse).all()


def test_the_floor_of_a_linear_system_is_its_noise():
    assert linear_floor(linear_system(), 4).rmse[0] < 1e-6
    # noise of the last observation, plus the decayed noise of the first
    expected = 0.1 * np.sqrt(1.0 + 0.9**8)
    assert linear_floor(linear_system(5000, noise=0.1), 4).rmse[0] == pytest.approx(expected, rel=0.05)


def test_recent_actions_help_where_actuation_is_late():
    data = linear_system()
    late = replace(data, action=np.vstack([data.action[3:], np.zeros((3, 1))]))
    assert linear_floor(late, 4, recent=3).rmse[0] < 0.1 * linear_floor(late, 4).rmse[0]


def test_the_floor_is_fitted_without_held_out_rows():
    data = linear_system()
    spoilt = replace(data, following=data.following + data.held_out[:, None] * 1.0)
    assert linear_floor(spoilt, 4).rmse[0] == pytest.approx(1.0, abs=1e-3)


def test_too_few_windows_for_a_floor_are_refused():
    with pytest.raises(ValueError, match=r"too few to fit 21 coefficients.*shorter horizon"):
        linear_floor(linear_system(rows=50), 20)
