"""Residuals of a problem do not depend on which effects were put in when its start states were computed."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import GeomSize, ObservationBias, ObservationGain
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.trace.problem import Problem


@pytest.mark.parametrize("effect", [ObservationGain(1.3, (1,)), ObservationBias(0.2, (0,))], ids=["gain", "bias"])
def test_states_that_the_right_sensors_read_are_not_read_by_them_again(effect):
    simulation = pendulum()
    data = recorded(simulation, 300)
    read = effect.process(simulation.control_step, None)
    data = replace(data, observation=read(data.observation), following=read(data.following))
    posed = Problem.pose(simulation.with_effects(effect), data)
    starts = data.windows(1)
    size = np.abs((data.following - data.observation)[starts]).mean(0)
    without = replace(posed, simulation=simulation)
    missed = without.residual([effect], starts) * without.scale_of(starts)
    assert np.abs(missed).max() < 1e-6 * size.max()
    assert np.abs(without.residual([], starts)).max() > 100.0


def test_unobserved_coordinates_follow_from_the_effects():
    """The robot's height is not observed. Start states with wheels that are a tenth smaller would bury them."""
    simulation, larger = Simulation.from_env(WheelLeggedEnv()), GeomSize(1.1, geoms="*wheel*")
    env = TransformedEnv(WheelLeggedEnv(), DynamicsGap(larger))
    measured = Measured.from_ted(record(env, noisy_balance_controller(), 300, seed=0), simulation)
    posed, starts = Problem.pose(simulation, measured), measured.fitted()
    without, with_it = (np.abs(posed.residual(effects, starts)).mean() for effects in ([], [larger]))
    assert with_it < 1e-3 * without


@pytest.mark.parametrize(("missed", "within"), [(0.02, True), (0.2, False)])
def test_a_few_rows_in_which_a_wheel_lands_do_not_count_as_a_missing_effect(missed, within):
    env = WheelLeggedEnv()
    simulation = Simulation.from_env(env)
    measured = Measured.from_ted(record(env, noisy_balance_controller(), 300, seed=0), simulation)
    following = measured.following.copy()
    landed = np.random.default_rng(0).random(len(following)) < missed
    following[landed] += 0.5 * (following - measured.observation).std(0)
    problem = Problem.pose(simulation, replace(measured, following=following), sensor_std=np.zeros(4))
    assert problem.within_rounding is within
