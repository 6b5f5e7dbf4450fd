"""What looks like sensor noise may be an error of the effects found so far."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointDamping, ObservationGain
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.rescale import without_noise
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = pendulum()
GAIN = CatalogueEntry(ObservationGain(entries=(1,)), ({"scale": 1.25},))
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 1.25},))
TRUTH = (ObservationGain(1.3, entries=(1,)), Gravity(1.2))


def nearly_found(entries, truth, noise=0.0):
    """A search that has found the entries with wrong values, and takes the rest for noise of the velocity's sensor."""
    measured = observed(truth, noise)
    state = SearchState.begin(Problem.pose(SIMULATION, measured), entries, np.random.default_rng(0))
    found = tuple(entry.effect.with_parameters({"scale": 1.15}) for entry in entries)
    state = state.with_found(entries, Fit(found, (("scale",),) * len(entries), 1.0, ({},) * len(entries)))
    taken_for_noise = np.array([0.0, 0.05]) * measured.observation.std(0)
    posed = Problem.pose(SIMULATION.with_effects(*found), measured, sensor_std=taken_for_noise)
    return state.rescaled(posed)


def observed(truth, noise):
    """Data of the pendulum with a wrong sensor; ``recorded`` leaves sensor effects out."""
    measured = recorded(SIMULATION.with_effects(*truth), noise=noise)
    scale = np.array([1.0, truth[0].scale])
    return replace(measured, observation=scale * measured.observation, following=scale * measured.following)


def test_a_wrong_gain_of_a_sensor_is_fitted_exactly_although_it_was_taken_for_noise():
    state = nearly_found((GAIN, GRAVITY), TRUTH)
    exact = without_noise(state)
    assert exact.exact
    assert [effect.scale for effect in exact.fit.effects] == pytest.approx([1.3, 1.2], rel=1e-4)


@pytest.mark.parametrize(
    ("entries", "truth", "noise"),
    [
        ((GAIN,), TRUTH, 0.0),
        ((GAIN, GRAVITY), TRUTH, 0.01),
        ((GRAVITY,), (ObservationGain(1.0, entries=(1,)), Gravity(1.2), JointDamping(0.1)), 0.0),
    ],
)
def test_with_noise_or_a_missing_effect_nothing_changes(entries, truth, noise):
    state = nearly_found(entries, truth, noise)
    assert without_noise(state) is state
