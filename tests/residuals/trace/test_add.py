"""Which entries are tried beside the effects found."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointDamping
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.trace.add import additions, other_singles
from torchrl_h2o.residuals.trace.grow import grow
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.state import SearchState

GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 0.05}, {"damping": -0.05}))
ONE_AT_FIRST = replace(DEFAULTS, trace=replace(DEFAULTS.trace, set_sizes=((1, 1),)))


@pytest.fixture
def posed():
    """A search in data of a pendulum with other gravity, which tries one entry at first, and the wrong one."""
    simulation, rng = pendulum(), np.random.default_rng(0)
    problem = Problem.pose(simulation, recorded(simulation.with_effects(Gravity(1.3)), 1000))
    state = SearchState.begin(problem, [DAMPING, GRAVITY], rng, ONE_AT_FIRST)
    leads = screen(problem, (), [DAMPING, GRAVITY], state.windows.screened)
    return state, sorted(leads, key=lambda lead: lead.entry is GRAVITY), rng


def test_entries_that_were_passed_over_are_tried_at_the_end(posed):
    state, damping_first, rng = posed
    passed_over = additions(state, damping_first, rng)
    assert not passed_over.near
    assert set(passed_over.state.attempts) == {DAMPING.name}
    others = other_singles(state, damping_first, rng)
    assert [one.entries for one in others.near] == [(GRAVITY,)]
    assert set(others.state.attempts) == {GRAVITY.name}


@pytest.mark.parametrize(("noise", "found"), [(0.0, (GRAVITY,)), (0.02, ())])
def test_a_search_ends_only_after_it_tried_all_entries_unless_sensors_have_noise(noise, found):
    simulation, rng = pendulum(), np.random.default_rng(0)
    problem = Problem.pose(simulation, recorded(simulation.with_effects(Gravity(1.3)), 1000, noise))
    none_at_first = replace(DEFAULTS, trace=replace(DEFAULTS.trace, set_sizes=((1, 0),)))
    state = SearchState.begin(problem, [DAMPING, GRAVITY], rng, none_at_first)
    with LoopBar(disable=True) as bar:
        assert tuple(entry.name for entry in grow(state, rng, bar).entries) == tuple(entry.name for entry in found)
