"""The state of the search."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionDelay, CatalogueEntry, Gravity
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState


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
