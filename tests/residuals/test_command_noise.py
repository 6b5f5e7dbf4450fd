"""Commands that were logged with noise are replaced by their expectation, where the readings show the noise."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.residuals.command_noise import expected_commands, unpredicted
from torchrl_h2o.residuals.ground import Found, Ground

SIMULATION = double_pendulum()


@pytest.fixture(scope="module")
def measured():
    return recorded(SIMULATION, 2000, noise=1e-4)


def noisy(measured, share):
    noise = share * measured.action.std(0) * np.random.default_rng(1).standard_normal(measured.action.shape)
    return replace(measured, action=measured.action + noise)


def near(measured):
    ground = Ground.of(SIMULATION, measured)
    return ground.near(Found((), (), np.zeros(0)), measured)[0]


def test_expected_commands_are_nearer_to_the_true_ones(measured):
    logged = noisy(measured, 0.3)
    ground = near(logged)
    assert ground.logged is logged
    errors = [np.std(one.action - measured.action) for one in (ground.base.fit.record.measured, logged)]
    assert errors[0] < 0.9 * errors[1]


def test_commands_stay_if_others_predict_hardly_better(measured):
    assert near(noisy(measured, 0.05)).logged is None


def test_commands_that_the_log_tells_have_no_noise(measured):
    assert not list(expected_commands(replace(measured, action=measured.observation[:, 2:4])))


def test_a_command_is_told_within_its_run(measured):
    run = np.arange(2000) // 5
    held = np.random.default_rng(0).standard_normal((400, 2))[run]
    assert np.abs(unpredicted(replace(measured, action=held, run=run))).max() < 1e-9


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_commands_that_the_readings_support_stay(measured, share):
    """The control: the machine has felt the noise, too, or there is none."""
    felt = noisy(measured, share)
    states = SIMULATION.rollout(measured.observation[:1], felt.action[None])[0]
    observed = np.vstack([measured.observation[:1], states])
    log = replace(felt, observation=observed[:-1], following=observed[1:])
    assert near(log).base.fit.record.measured is log


def test_what_later_readings_would_tell_of_a_command_is_unpredicted(measured):
    """Each command is told by its neighbours, the others and earlier readings."""
    action = np.random.default_rng(0).standard_normal((2000, 2))
    action[:, 1] = action[:, 0] + 0.1 * action[:, 1]
    left = unpredicted(replace(measured, action=action)).std(0)
    assert left == pytest.approx([0.1, 0.1], rel=0.1)
    of_next_row = replace(measured, action=measured.following[:, 2:4])
    of_this_row = replace(measured, action=measured.observation[:, 2:4])
    assert (unpredicted(of_this_row).std(0) < 1e-9).all()
    assert (unpredicted(of_next_row).std(0) > 0.01 * of_next_row.action.std(0)).all()
