"""Synthetic data that differ from the simulation by sensor noise alone."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import Gravity
from torchrl_h2o.residuals import Split, residuals
from torchrl_h2o.residuals.measured.sensor_noise import sensor_noise, sensor_std, stand_in

SIMULATION = pendulum()


def test_data_without_noise_need_no_stand_in():
    assert sensor_noise(SIMULATION, recorded(SIMULATION)) is None


@pytest.mark.parametrize("lacking", [(), (Gravity(1.05),)], ids=["right simulator", "wrong simulator"])
def test_the_sensors_noise_is_found(lacking):
    real = SIMULATION.with_effects(*lacking)
    found = sensor_noise(SIMULATION, recorded(real, 3000, noise=0.02))
    np.testing.assert_allclose(found, 0.02 * recorded(real, 3000).observation.std(0), rtol=0.25)


@pytest.mark.parametrize("horizon", [1, 5])
def test_nothing_is_missing_from_a_stand_in(horizon):
    """The stand-in is made from data measured under another gravity, but is simulated without this gap."""
    measured = recorded(SIMULATION.with_effects(Gravity(1.5)), 600)
    data = stand_in(SIMULATION, measured, np.zeros(2), np.random.default_rng(0), horizon)
    for split in (Split.FIT, Split.SELECTION):
        starts = data.windows(horizon, horizon, split=split)
        assert np.abs(residuals(SIMULATION, data, starts, horizon)).max() < 1e-9
        assert np.abs(residuals(SIMULATION, measured, starts, horizon)).max() > 1e-3


def test_a_stand_in_is_read_by_noisy_sensors_and_leaves_the_data_as_they_are():
    measured = recorded(SIMULATION, 2000)
    kept = replace(measured, following=measured.following.copy(), observation=measured.observation.copy())
    std = np.array([0.01, 0.3])
    data = stand_in(SIMULATION, measured, std, np.random.default_rng(0))
    for name in ("observation", "following"):
        np.testing.assert_allclose((getattr(data, name) - getattr(measured, name)).std(0), std, rtol=0.1)
        np.testing.assert_array_equal(getattr(measured, name), getattr(kept, name))
    np.testing.assert_array_equal(data.action, measured.action)


def test_estimated_columns_are_at_least_as_noisy_as_is_known():
    """Successive residuals do not show errors that are alike in successive rows, as those of a smoother."""
    measured = recorded(SIMULATION, 600, noise=0.001)
    found = sensor_std(SIMULATION, measured)
    known = np.array([0.0, 10.0 * found[1]])
    assert sensor_std(SIMULATION, replace(measured, estimated_std=known)) == pytest.approx([found[0], known[1]])
