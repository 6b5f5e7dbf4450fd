"""Choice of the horizon: one step with good sensors, longer where a gap must exceed the sensors' noise."""

import numpy as np

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import Gravity, JointDamping
from torchrl_h2o.residuals.trace.choose_horizon import choose_horizon


def chosen(truth, **kwargs):
    simulation = pendulum()
    measured = recorded(simulation.with_effects(truth), **kwargs)
    return choose_horizon(simulation, measured, np.random.default_rng(0))


def test_one_step_is_enough_without_noise():
    assert chosen(Gravity(1.01), transitions=4000) == 1


def test_small_gaps_under_noise_are_looked_for_further_ahead():
    assert chosen(Gravity(1.2), transitions=4000, noise=0.03) > 1


def test_few_data_do_not_allow_long_windows():
    assert chosen(Gravity(1.2), transitions=250, noise=0.03) <= 6  # of 125 rows for fits, 20 windows


def test_a_slow_loss_of_energy_is_looked_for_further_ahead_than_a_large_gap():
    slow, large = (chosen(truth, transitions=6000, noise=0.01) for truth in (JointDamping(0.002), Gravity(1.5)))
    assert slow > large
