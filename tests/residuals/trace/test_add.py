"""Which entries are tried beside the effects found."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointDamping
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.trace.add import additions
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.state import SearchState

GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 0.05}, {"damping": -0.05}))
ONE_AT_FIRST = replace(DEFAULTS, trace=replace(DEFAULTS.trace, set_sizes=((1, 1),)))


@pytest.mark.parametrize(("noise", "found"), [(0.0, [GRAVITY.name]), (0.02, [])])
def test_entries_of_little_promise_are_tried_where_there_is_no_noise(noise, found):
    """With noise, an entry of little promise would be chosen by chance more often than because it is missing."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(Gravity(1.3)), 1000, noise)
    problem, rng = Problem.pose(simulation, measured), np.random.default_rng(0)
    assert (problem.sensor_std is None) == (noise == 0.0)
    state = SearchState.begin(problem, [DAMPING, GRAVITY], rng, ONE_AT_FIRST)
    leads = screen(problem, (), [DAMPING, GRAVITY], state.windows.screened)
    damping_first = sorted(leads, key=lambda lead: lead.entry is GRAVITY)
    added = additions(state, damping_first, rng)
    assert [entry.name for one in added.near for entry in one.entries] == found
    assert set(added.state.attempts) == {DAMPING.name, *found}
