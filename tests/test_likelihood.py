"""Which of two explanations predicts better, paired over blocks."""

import numpy as np
import pytest

from torchrl_h2o.likelihood import ENOUGH, Difference


def losses(windows=300, seed=0):
    return np.random.default_rng(seed).exponential(size=windows)


def test_lower_losses_are_evidence_and_higher_ones_are_evidence_against():
    worse, better = losses(), 0.5 * losses(seed=1)
    assert Difference.of_losses(worse, better).evidence > 2.0 * ENOUGH
    assert Difference.of_losses(better, worse).evidence < -2.0 * ENOUGH


@pytest.mark.parametrize(("windows", "alike"), [(8, 1), (30, 1), (300, 1), (300, 4)])
def test_chance_is_rarely_taken_for_evidence(windows, alike):
    """A level of 1 % is asked. Losses of neighbouring windows may resemble each other, if blocks hold more of them."""
    kernel = np.ones(alike) / alike
    pairs = [[np.convolve(losses(windows + alike - 1, 2 * s + i), kernel, "valid") for i in (0, 1)] for s in range(400)]
    assert np.mean([Difference.of_losses(*pair).evidence > ENOUGH for pair in pairs]) < 0.02


def test_equal_losses_no_losses_and_losses_that_vanish():
    same = losses()
    assert Difference.of_losses(same, same).evidence == 0.0
    assert Difference.of_losses(np.zeros(40), np.zeros(40)).evidence == 0.0
    assert Difference.of_losses(same, np.zeros(300)).evidence > ENOUGH
    assert not Difference.of_losses(same, np.full(300, np.nan)).evidence > 0.0


def test_what_acts_in_three_blocks_of_thirty_shows_no_evidence():
    rare = np.full(300, 0.01)
    rare[[5, 105, 205]] = 5.0
    assert Difference.of_losses(rare, np.full(300, 0.01)).evidence == 0.0


def test_bursts_that_only_gain_are_evidence_and_bursts_that_also_lose_are_not():
    """The scatter of bursts hides their mean from a test of normal values."""
    rng = np.random.default_rng(0)
    quiet, bursts = 0.1 * rng.normal(size=60), np.zeros(60)
    bursts[::6] = 6.0 * rng.exponential(size=10)
    assert Difference(quiet + bursts).evidence > 1.1 * ENOUGH
    assert Difference(-(quiet + bursts)).evidence < -1.1 * ENOUGH
    assert abs(Difference(quiet + bursts * rng.choice([-1.0, 1.0], size=60)).evidence) < 0.5 * ENOUGH
