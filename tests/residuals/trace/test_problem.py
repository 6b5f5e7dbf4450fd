"""Residuals of a problem do not depend on which effects were put in when its start states were computed."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import GeomSize, ObservationBias, ObservationGain
from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
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
    """The robot's height is not observed, and wheels that are a tenth larger carry it higher by a tenth of a radius."""
    simulation = Simulation.from_env(WheelLeggedEnv())
    measured = Measured.from_ted(record(WheelLeggedEnv(), noisy_balance_controller(), 300, seed=0), simulation)
    posed, starts, larger = Problem.pose(simulation, measured), measured.fitted(), [GeomSize(1.1, geoms="*wheel*")]
    settled = posed.settled(larger, starts)
    height = settled.states[starts, 1] - posed.states[starts, 1]
    assert height == pytest.approx(0.1 * simulation.model.geom("left_wheel").size[0], rel=0.3)
    observed = simulation.state_map.observations
    assert np.array_equal(observed(settled.states), observed(posed.states))
    sunk, standing = (np.abs(problem.residual(larger, starts)).mean() for problem in (posed, settled))
    assert standing < 0.3 * sunk


def test_the_pendulum_has_no_unobserved_coordinates():
    problem = Problem.pose(pendulum(), recorded(pendulum(), 300))
    assert problem.settled([ObservationBias(0.2, (0,))], np.arange(10)) is problem
