"""Windows that a report shows: the worst, the median and the best one by the error with the effects."""

import dataclasses

import numpy as np

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import Gravity, JointDamping
from torchrl_h2o.residuals.judge.shown_windows import shown_windows
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Split

SIMULATION = pendulum()
REAL = SIMULATION.with_effects(Gravity(1.5), JointDamping(0.1))
MENDED = SIMULATION.with_effects(Gravity(1.5))
MEASURED = recorded(REAL)
ROWS = np.arange(len(MEASURED))


def test_windows_are_ranked_by_the_error_with_the_effects_and_held_out():
    windows = shown_windows(SIMULATION, MENDED, MEASURED, 10)
    assert [window.rank for window in windows] == ["worst", "median", "best"]
    worst, median, best = windows
    assert worst.after > median.after > best.after
    starts = MEASURED.reported_on(10)
    missed = residuals(MENDED, MEASURED, starts, 10)[:, -1]
    change = MEASURED.following[starts + 9] - MEASURED.observation[starts]
    errors = np.sqrt(((missed / change.std(0)) ** 2).mean(-1))
    assert worst.row == starts[errors.argmax()]
    assert worst.after == np.float64(errors.max())
    assert best.after == errors.min()
    assert all(MEASURED.held_out[window.row] for window in windows)


def test_a_window_holds_the_measured_values_and_both_simulations():
    for window in shown_windows(SIMULATION, MENDED, MEASURED, 10):
        assert window.start == MEASURED.time[window.row]
        np.testing.assert_allclose(window.ahead, 0.02 * np.arange(11))
        start = MEASURED.observation[window.row][None]
        actions = MEASURED.action[window.row : window.row + 10][None]
        for quantity in window.quantities:
            column = SIMULATION.state_map.names.index(quantity.name)
            assert quantity.unit == SIMULATION.state_map.units[column]
            np.testing.assert_allclose(quantity.measured[0], start[0, column])
            np.testing.assert_allclose(quantity.measured[1:], MEASURED.following[window.row :][:10, column])
            for which, values in ((SIMULATION, quantity.before), (MENDED, quantity.after)):
                simulated = which.rollout(which.state_map.states(start), actions)[0, :, column]
                np.testing.assert_allclose(values[1:], simulated, atol=1e-12)


def test_few_windows_are_shown_once_and_none_not_at_all():
    few = dataclasses.replace(MEASURED, split=np.where(len(ROWS) - 10 <= ROWS, Split.REPORT, Split.FIT))
    assert [window.rank for window in shown_windows(SIMULATION, MENDED, few, 10)] == ["worst"]
    none = dataclasses.replace(MEASURED, split=np.full(len(ROWS), Split.FIT))
    assert shown_windows(SIMULATION, MENDED, none, 10) == ()


def test_a_diverging_window_is_the_worst():
    row = int(MEASURED.reported_on(10)[5])
    observation = MEASURED.observation.copy()
    observation[row, 1] = 1e12
    broken = dataclasses.replace(MEASURED, observation=observation)
    worst = shown_windows(SIMULATION, MENDED, broken, 10)[0]
    assert worst.row == row
    assert np.isnan(worst.after)
