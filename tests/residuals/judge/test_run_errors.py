"""The error of each run."""

import dataclasses

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import Gravity
from torchrl_h2o.residuals.judge.held_out_error import overall_error
from torchrl_h2o.residuals.judge.run_errors import MAX_RUNS, run_errors
from torchrl_h2o.residuals.measured.transitions import Split

SIMULATION = pendulum()
REAL = SIMULATION.with_effects(Gravity(1.5))
HALF = SIMULATION.with_effects(Gravity(1.25))
MEASURED = recorded(REAL)
MEASURED = dataclasses.replace(MEASURED, split=np.repeat([Split.FIT, Split.SELECTION, Split.REPORT], [800, 250, 450]))
RUNS = dataclasses.replace(MEASURED, run=np.repeat([0, 1, 2], [500, 700, 300]))


def test_a_run_is_judged_by_its_held_out_part_or_as_a_whole():
    runs = run_errors(SIMULATION, HALF, RUNS)
    assert [(run.name, run.rows, run.held_out) for run in runs] == [
        ("0", 500, False),
        ("1", 150, True),
        ("2", 300, True),
    ]
    for run in runs:
        assert run.after == pytest.approx(run.before / 2, rel=0.02)


def test_a_single_run_has_the_error_of_the_summary():
    (run,) = run_errors(SIMULATION, HALF, MEASURED)
    assert run.before == pytest.approx(overall_error(SIMULATION, MEASURED))
    assert run.after == pytest.approx(overall_error(HALF, MEASURED))


def test_runs_without_usable_rows_and_too_many_runs_are_left_out():
    gone = dataclasses.replace(RUNS, usable=RUNS.run != 1)
    assert [run.name for run in run_errors(SIMULATION, HALF, gone)] == ["0", "2"]
    many = dataclasses.replace(RUNS, run=np.minimum(np.arange(1500) // 5, MAX_RUNS))
    names = [run.name for run in run_errors(SIMULATION, HALF, many)]
    assert len(names) == MAX_RUNS
    assert str(MAX_RUNS) in names  # the longest one
