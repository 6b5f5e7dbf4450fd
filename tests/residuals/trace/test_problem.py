"""Residuals of a problem do not depend on which effects were put in when its start states were computed."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ObservationBias, ObservationGain
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
