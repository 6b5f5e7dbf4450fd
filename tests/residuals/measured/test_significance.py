"""The paired test: p-values are valid under the null hypothesis, also for dependent neighbours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from torchrl_h2o.residuals.measured.significance import p_value, p_value_of_losses


def noise(seed, windows=300, memory=0.0):
    rng = np.random.default_rng(seed)
    gain = rng.standard_normal(windows)
    for t in range(1, windows):
        gain[t] += memory * gain[t - 1]
    return gain


def test_p_values_of_no_gain_are_as_small_as_they_say_and_no_oftener():
    values = np.array([p_value(noise(seed)) for seed in range(300)])
    for level in (0.01, 0.05, 0.2):
        share = (values < level).mean()
        assert stats.binomtest(round(share * 300), 300, level, alternative="greater").pvalue > 0.01
        assert share > 0.2 * level


def test_what_is_small_and_everywhere_is_seen_beside_what_is_large_and_rare():
    everywhere = 0.01 + 0.001 * noise(0)
    everywhere[::60] -= 0.1  # rare, with the opposite sign
    assert p_value(everywhere) < 1e-3
    rare = np.zeros(300)
    rare[5::20] = 1.0
    assert p_value(rare) < 1e-3


def test_neighbours_that_depend_on_each_other_are_not_taken_for_evidence():
    chance = np.mean([p_value(noise(seed, 600, memory=0.6)) < 0.05 for seed in range(150)])
    assert chance < 0.09


def test_a_clear_gain_is_hardly_chance():
    assert p_value(noise(0) + 2.0) < 1e-6


def test_a_loss_is_no_gain():
    assert p_value(noise(0) - 2.0) > 0.999


def test_no_gain_at_all_proves_nothing_and_the_same_everywhere_everything():
    assert p_value(np.zeros(50)) == 1.0
    assert p_value(np.full(50, -0.5)) == 1.0
    assert p_value(np.full(50, 0.5)) == 0.0


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), scale=st.floats(1e-6, 1e6), windows=st.integers(2, 400))
def test_the_unit_of_the_loss_does_not_matter_and_a_gain_one_way_is_none_the_other(seed, scale, windows):
    gain = noise(seed, windows)
    assert p_value(scale * gain) == pytest.approx(p_value(gain), abs=1e-9)
    assert p_value(gain) + p_value(-gain) >= 1.0 - 1e-9


def robust(residual):
    return np.sqrt(1.0 + residual**2).mean(1) - 1.0


@pytest.mark.parametrize(("dimensions", "change"), [(1, 0.1), (1, 10.0), (3, 1.0)])
def test_losses_that_change_by_chance_are_as_seldom_significant_as_they_should_be(dimensions, change):
    """Residuals of very different sizes, changed by independent noise."""
    significant = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        size = np.exp(2.0 * rng.standard_normal((300, 1)))
        residual, moved = (size * rng.standard_normal((300, dimensions)) for _ in range(2))
        significant += p_value_of_losses(robust(residual), robust(residual + change * moved)) < 0.02
    assert stats.binomtest(significant, 100, 0.02, alternative="greater").pvalue > 0.01


def concentrated(rng, dimensions):
    """Residuals that are large in about every seventh block, and constant within it."""
    size = np.where(rng.random((30, 1)) < 0.15, 10.0, 1e-4)
    return lambda: np.repeat(size * rng.standard_normal((30, dimensions)), 10, axis=0)


def rare(rng, dimensions):
    """Residuals that are large in one of a hundred windows."""
    size = np.where(rng.random((300, 1)) < 0.01, 10.0, 1e-4)
    return lambda: size * rng.standard_normal((300, dimensions))


@pytest.mark.parametrize("residuals", [concentrated, rare])
@pytest.mark.parametrize(("dimensions", "change"), [(1, 0.1), (3, 1.0)])
def test_rare_residuals_that_change_by_chance_are_no_evidence(residuals, dimensions, change):
    """Where residuals are large, the change that an effect makes is large too, but it points anywhere."""
    significant = 0
    for seed in range(150):
        draw = residuals(np.random.default_rng(seed), dimensions)
        residual, moved = draw(), draw()
        significant += p_value_of_losses(robust(residual), robust(residual + change * moved)) < 0.02
    assert stats.binomtest(significant, 150, 0.02, alternative="greater").pvalue > 0.01


def test_what_vanishes_now_and_then_is_seen():
    """The loss becomes zero in three blocks of thirty, which are too few for tests on means."""
    before, after = np.full(300, 1e-9), np.full(300, 1e-9)
    before[[5, 6, 7, 105, 106, 205]] = 5.0
    assert p_value(before - after) > 0.01
    assert p_value_of_losses(before, after) < 1e-5


def test_what_shrinks_now_and_then_by_a_little_is_not():
    before, after = np.full(300, 1e-9), np.full(300, 1e-9)
    before[[5, 105, 205]], after[[5, 105, 205]] = 5.0, 2.0
    assert p_value_of_losses(before, after) > 0.01


def test_losses_that_stay_or_grow_prove_nothing():
    same = np.abs(noise(0))
    assert p_value_of_losses(same, same) == 1.0
    assert p_value_of_losses(same, 2.0 * same) > 0.99
    assert p_value_of_losses(np.zeros(40), np.zeros(40)) == 1.0
