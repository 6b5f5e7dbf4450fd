"""Runs of the benchmark of close_the_loop: which cases run, what is shown to them, and what is counted."""

import json

import numpy as np
import pytest
from cases import Case
from drawn_cases import plain
from families import FAMILIES, all_families, choose_families
from results_table import table
from running import Job, run_all
from speed import CountingSimulation
from systems import SYSTEMS

from tests.recipes.benchmarks.made_up import report
from torchrl_h2o.effects import (
    ActionGain,
    BodyMass,
    Gravity,
)
from torchrl_h2o.residuals import Simulation, residuals
from torchrl_h2o.residuals.report.document import Report

SEED = 5


def perfect(simulation, data, **options):
    """The report that would be correct for the first decoy case."""
    return report(Gravity(2.0), groups=[(BodyMass(2.0, bodies="arm"), ActionGain(0.5))])


def failing(simulation, data, **options):
    raise RuntimeError("diverged")


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(Case, "measure", lambda self: SYSTEMS[self.system].record(self.in_reality, 20, 0))
    monkeypatch.setattr(Report, "save", lambda self, folder: folder)


@pytest.mark.usefixtures("short")
def test_a_case_that_fails_is_a_row_and_the_others_go_on(tmp_path):
    jobs = [Job("decoy", number, SEED, tmp_path) for number in range(2)]
    calls = iter([failing, perfect])
    rows = run_all(jobs, 1, lambda *args, **kw: next(calls)(*args, **kw), progress=False)
    assert [row["ok"] for row in rows] == [False, True]
    assert "diverged" in rows[0]["found"]
    saved = json.loads((tmp_path / "results.json").read_text())
    assert [row["number"] for row in saved] == [0, 1]
    lines = (tmp_path / "results.csv").read_text().splitlines()
    assert lines[0].startswith("family,number,name,system,truth,found,ok")
    assert len(lines) == 3
    printed = table(choose_families(["decoy"]), rows)
    assert "1 of 2" in printed
    assert "4 of 4" in printed


@pytest.mark.usefixtures("short")
def test_the_code_under_test_is_shown_neither_the_truth_nor_the_case(tmp_path):
    seen = []

    def spy(*args, **options):
        seen.append((args, options))
        return report()

    run_all([Job("paper16_noise", 0, SEED, tmp_path)], 1, spy, progress=False)
    ((simulation, data), options) = seen[0]
    assert isinstance(simulation, Simulation)
    assert set(data.keys()) == {"observation", "action", "done", "terminated", "truncated", "next"}
    assert options.keys() == {"source", "held_out", "seed", "progress"}
    assert "gravity" not in options["source"]


def test_steps_are_counted_in_all_that_is_made_of_a_simulation():
    simulation, measured = plain("pendulum", 0)
    counting = CountingSimulation.of(simulation)
    mended = counting.with_effects(Gravity(0.5))
    starts = np.arange(7)
    expected = residuals(simulation.with_effects(Gravity(0.5)), measured, starts, 3)
    before = counting.count.steps
    assert (residuals(mended, measured, starts, 3) == expected).all()
    assert counting.count.steps - before == 21
    assert counting.count.seconds > 0.0


def test_steps_are_counted_where_coordinates_are_not_observed():
    """Earlier, each case of the robot whose log lacks the speed of its wheels failed."""
    simulation, measured = plain("wheel_legged", 0)
    counting = CountingSimulation.of(simulation)
    starts = np.arange(7)
    assert (residuals(counting, measured, starts, 3) == residuals(simulation, measured, starts, 3)).all()


def test_families_are_chosen_by_name_and_logs_by_their_folder(tmp_path):
    assert list(choose_families(["nothing", "paper16"])) == ["paper16", "nothing"]
    assert list(choose_families(["nothing"], tmp_path)) == ["nothing", "log_wheel_legged", "log_pendulum"]
    assert list(choose_families(["log_pendulum"], tmp_path)) == ["log_pendulum"]
    with pytest.raises(ValueError, match="cases=paper: choose from paper16"):
        choose_families(["paper"])
    with pytest.raises(FileNotFoundError, match="no such folder"):
        choose_families([], tmp_path / "nowhere")
    assert set(all_families(tmp_path)) - set(FAMILIES) == {"log_wheel_legged", "log_pendulum"}
