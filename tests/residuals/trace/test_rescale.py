"""Effects are fitted once more where they leave much less than the residuals that scaled their fit."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointFrictionLoss
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.rescale import rescale
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = pendulum()
TRUTH = (Gravity(1.3), JointFrictionLoss(0.2))
ENTRIES = (
    CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25})),
    CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1})),
)
NEAR = (Gravity(1.31), JointFrictionLoss(0.199))


def near_the_truth(noise=0.0):
    """A search in data with two effects that has found both of them, with values that are a little off."""
    measured = recorded(SIMULATION.with_effects(*TRUTH), 600, noise=noise)
    begun = SearchState.begin(Problem.pose(SIMULATION, measured), ENTRIES, np.random.default_rng(0))
    return begun.with_found(ENTRIES, replace(begun.refitted(ENTRIES, TRUTH), effects=NEAR))


def values(state):
    return [state.fit.effects[0].scale, state.fit.effects[1].torque]


def test_effects_are_fitted_again_where_they_leave_much_less_than_the_scale_of_their_fit():
    state = rescale(near_the_truth())
    assert values(state) == pytest.approx([1.3, 0.2], rel=1e-5)
    assert state.exact


def test_effects_are_fitted_again_where_what_looked_like_sensor_noise_was_their_error():
    state = near_the_truth()
    posed = state.posed_at(NEAR)
    noisy = state.rescaled(replace(posed, sensor_std=np.full(2, 0.01)))
    assert values(rescale(noisy)) == pytest.approx([1.3, 0.2], rel=1e-5)


def test_effects_whose_fit_has_the_present_scale_are_not_fitted_again():
    state = near_the_truth()
    state = rescale(state.rescaled(state.posed_at(NEAR)))
    assert values(state) == [1.31, 0.199]
    assert not state.exact
