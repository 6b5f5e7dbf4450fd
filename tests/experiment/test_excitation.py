"""Candidates of commands: smooth, within a band, at rest at both ends."""

import numpy as np
import pytest

from torchrl_h2o.experiment.excitation import FAMILIES, candidate, spline


@pytest.mark.parametrize("family", FAMILIES)
def test_commands_begin_and_end_at_rest_and_stay_in_bounds(family):
    for seed in range(5):
        knots = candidate(family, 5.0, 2, 3.0, np.random.default_rng(seed))
        path = spline(knots, 5.0, 500)
        assert path.shape == (500, 2)
        assert np.abs(path).max() <= 1.0 + 1e-9
        assert np.abs(path).max() > 0.3
        assert path[0] == pytest.approx(0.0)
        assert np.abs(path[-15:]).max() == pytest.approx(0.0, abs=1e-9)
        assert np.abs(np.diff(path, axis=0)).max() < 0.2  # no jump: at 3 Hz, a step takes a sixth of a second


@pytest.mark.parametrize("family", FAMILIES)
def test_hardly_any_power_is_above_the_band(family):
    path = spline(candidate(family, 10.0, 1, 2.0, np.random.default_rng(0)), 10.0, 2000)[:, 0]
    power = np.abs(np.fft.rfft(path)) ** 2
    above = np.fft.rfftfreq(len(path), 0.005) > 4.0
    assert power[above].sum() < 0.02 * power.sum()


def test_draws_differ_and_a_seed_repeats_them():
    one, same, other = (candidate("multisine", 5.0, 2, 3.0, np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert (one == same).all()
    assert (one != other).any()
