"""Windows in which something moves: the others say nothing about a simulator's predictions."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded, three_parts
from torchrl_h2o.effects import JointDamping
from torchrl_h2o.residuals import Split
from torchrl_h2o.residuals.judge.prediction_table import predicted
from torchrl_h2o.residuals.measured.in_motion import in_motion
from torchrl_h2o.residuals.measured.moving_rows import moving_rows

DAMPED = pendulum().with_effects(JointDamping(0.5))


def resting_for(share, noise=0.0, rows=1500):
    """A pendulum that moves, in each part of the data, after it has rested for a share of the rows."""
    log = recorded(DAMPED, rows, noise=noise)
    split, rng = three_parts(rows), np.random.default_rng(0)
    still = np.zeros(rows, bool)
    for part in Split:
        own = np.flatnonzero(split == part)
        still[own[: round(share * len(own))]] = True
    noise_std = noise * log.observation.std(0)
    readings = noise_std * rng.standard_normal((2, rows, 2))
    observation, following = log.observation.copy(), log.following.copy()
    observation[still], following[still] = readings[0][still], readings[1][still]
    action = np.where(still[:, None], 0.0, log.action)
    run = np.cumsum(np.concatenate([[0], np.abs(np.diff(still.astype(int)))]))
    return replace(log, observation=observation, following=following, action=action, run=run), still


def test_windows_at_rest_are_left_out_with_and_without_noise():
    for noise in (0.0, 0.01):
        log, still = resting_for(0.7, noise)
        starts = log.reported_on(10)
        moving = in_motion(log, starts, 10, least=3)
        assert set(moving) <= set(starts[~still[starts]])
        assert len(moving) > 0.9 * (~still[starts]).sum()


@pytest.mark.parametrize("steps", [1, 2, 10])
def test_noise_alone_does_not_choose_windows(steps):
    """In short windows, a threshold on each would keep those with the largest noise."""
    log = recorded(DAMPED, 1500, noise=0.05)
    assert len(in_motion(log, log.fitted(steps), steps, least=1)) > 0.95 * len(log.fitted(steps))


def test_a_reading_that_changes_between_two_neighbouring_values_stands_still():
    readings = np.sin(0.1 * np.arange(400.0))[:, None]
    readings[200:] = readings[200]
    readings = np.round(readings / 0.01) * 0.01
    readings[250::10] += 0.01
    moves = moving_rows(readings, np.zeros(400, int))
    assert moves[:195].all()
    assert not moves[210:].any()


def test_all_windows_are_kept_if_too_few_move():
    log, _ = resting_for(0.7)
    starts = log.reported_on(10)
    assert len(in_motion(log, starts, 10, least=1)) < len(starts)
    assert in_motion(log, starts, 10, least=len(starts)).tolist() == starts.tolist()


def test_a_right_effect_explains_the_motion_of_a_log_that_mostly_rests():
    """At rest the guess that velocities stay as they are is exact; so most windows would speak against any effect."""
    log, still = resting_for(0.7, rows=3000)
    total, moving = (
        predicted(DAMPED, DAMPED, data, 10, seed=0).table.rows[0] for data in (log, replace(log, usable=~still))
    )
    assert total.mended.error < 0.8 * total.velocities_stay.error
    assert total.velocities_stay.error == pytest.approx(moving.velocities_stay.error, rel=0.2)
