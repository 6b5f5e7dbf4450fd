"""Choice of the horizon: one step with good sensors, longer where a gap must exceed the sensors' noise."""

import numpy as np

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity
from torchrl_h2o.residuals.trace.choose_horizon import choose_horizon

GRAVITY = [CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))]


def chosen(truth, catalogue=GRAVITY, **kwargs):
    simulation = pendulum()
    measured = recorded(simulation.with_effects(truth), **kwargs)
    return choose_horizon(simulation, measured, catalogue, np.random.default_rng(0))


def test_one_step_is_enough_without_noise():
    assert chosen(Gravity(1.01), transitions=4000) == 1


def test_small_gaps_under_noise_are_looked_for_further_ahead():
    assert chosen(Gravity(1.2), transitions=4000, noise=0.03) > 1


def test_few_data_do_not_allow_long_windows():
    assert chosen(Gravity(1.2), transitions=250, noise=0.03) == 1


def test_a_catalogue_of_nothing_needs_one_step():
    assert chosen(Gravity(1.2), catalogue=[], transitions=1000) == 1
