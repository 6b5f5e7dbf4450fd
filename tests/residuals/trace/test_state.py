"""The state of the search."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionDelay, CatalogueEntry, Gravity
from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState


def pendulum_data():
    simulation = pendulum()
    return simulation, recorded(simulation, 500)


def robot_data():
    simulation, robot = Simulation.from_env(WheelLeggedEnv()), TransformedEnv(WheelLeggedEnv())
    return simulation, Measured.from_ted(record(robot, noisy_balance_controller(), 500, seed=0), simulation)


@pytest.mark.parametrize(
    ("data", "share"),
    [(pendulum_data, DEFAULTS.trace.min_share), (robot_data, DEFAULTS.trace.min_share_unobserved)],
)
def test_an_effect_must_contribute_more_where_coordinates_are_not_observed(data, share):
    """The robot's height is estimated, and an effect may make up for the error of the estimate."""
    simulation, measured = data()
    state = SearchState.begin(Problem.pose(simulation, measured), (), np.random.default_rng(0))
    assert state.min_share == share


def test_other_explanations_of_exact_effects_must_reach_more_in_a_quick_fit():
    simulation, measured = pendulum_data()
    state = SearchState.begin(Problem.pose(simulation, measured), (), np.random.default_rng(0))
    assert state.rival_min_sketch < replace(state, exact=True).rival_min_sketch < 1.0


@pytest.mark.parametrize(("noise", "noisy"), [(0.0, False), (0.01, True)])
def test_a_delay_is_no_noise_while_it_is_left_out(noise, noisy):
    """Without a delay shorter than a row the residual looks noisy; with all effects it shows the sensors' noise."""
    simulation, gravity, delay = pendulum(), Gravity(1.3), ActionDelay(0.004)
    measured = recorded(simulation.with_effects(gravity, delay), noise=noise)
    state = SearchState.begin(Problem.pose(simulation, measured), (), np.random.default_rng(0))
    entries = [CatalogueEntry(Gravity(), ({"scale": 0.8},)), CatalogueEntry(ActionDelay(), ({"delay": 0.01},))]
    state = state.with_found(entries, Fit((gravity, delay), (("scale",), ("delay",)), 0.0, ({},) * 2))
    assert state.posed_at([gravity]).sensor_std is not None
    for kept in ([gravity], []):
        assert (state.posed_instead(kept).sensor_std is not None) is noisy
