"""Runs of the benchmark of close_the_loop: which cases run, what is shown to them, and what is recorded."""

import json
from dataclasses import replace

import pytest
from cases import Case
from options import read_options
from running import FAMILIES, Job, run_all, run_case, table
from systems import SYSTEMS

from tests.recipes.benchmarks.made_up import report
from torchrl_h2o.comparison.records import read_records
from torchrl_h2o.effects import ActionGain, BodyMass, Gravity
from torchrl_h2o.residuals import Simulation
from torchrl_h2o.residuals.report.document import Report


def perfect(simulation, data, **options):
    """The report that would be correct for the first decoy case."""
    return report(Gravity(2.0), groups=[(BodyMass(2.0, bodies="arm"), ActionGain(0.5))])


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(Case, "measure", lambda self: SYSTEMS[self.system].record(self.in_reality, 20, 0))
    monkeypatch.setattr(Report, "save", lambda self, folder: folder)


@pytest.mark.usefixtures("short")
def test_a_case_that_fails_is_recorded_and_the_others_go_on(tmp_path):
    def trace(simulation, data, **options):
        return perfect(simulation, data) if options["seed"] == 1 else [][0]

    jobs = [Job("decoy", 0, seed=0), Job("decoy", 0, seed=1)]
    records = {record.name: record for record in run_all(jobs, 1, trace, tmp_path)}
    assert {name: record.values["ok"] for name, record in records.items()} == {
        "decoy_00": False,
        "decoy_00_seed1": True,
    }
    assert "IndexError" in records["decoy_00"].values["found"]
    assert "[][0]" in (tmp_path / "decoy_00.txt").read_text()
    assert {record.name for record in read_records(tmp_path, "drawn")} == records.keys()
    printed = table(records.values())
    assert "1 of 2" in printed
    assert "4 of 4" in printed


@pytest.mark.usefixtures("short")
def test_the_code_under_test_is_shown_neither_the_truth_nor_the_case(tmp_path):
    seen = []

    def spy(*args, **options):
        seen.append((args, options))
        return report()

    run_case(Job("paper16_noise", 0), spy, tmp_path)
    ((simulation, data), options) = seen[0]
    assert isinstance(simulation, Simulation)
    assert set(data.keys()) == {"observation", "action", "done", "terminated", "truncated", "next"}
    assert options.keys() == {"source", "held_out", "seed", "minutes", "progress"}
    assert "gravity" not in options["source"]


@pytest.mark.usefixtures("short")
def test_only_records_of_this_code_are_taken_over(tmp_path):
    run_case(Job("decoy", 0), perfect, tmp_path)
    (record,) = read_records(tmp_path, "drawn")
    unchanged = replace(record, made_by={**record.made_by, "dirty": False})
    assert not replace(unchanged, made_by={**unchanged.made_by, "commit": "0000000"}).is_current
    assert not replace(unchanged, made_by={**unchanged.made_by, "dirty": True}).is_current
    assert json.loads((tmp_path / "drawn" / "decoy_00.json").read_text())["made_by"]["cpu_s"] > 0.0


def test_options_have_the_types_of_their_defaults(monkeypatch):
    monkeypatch.setattr("sys.argv", ["script.py", "cases=[slow]", "draws=3"])
    cfg = read_options(cases=list(FAMILIES), draws=None)
    assert (list(cfg.cases), cfg.draws) == (["slow"], 3)
    monkeypatch.setattr("sys.argv", ["script.py", "case=[slow]"])
    with pytest.raises(SystemExit, match="case: choose from cases="):
        read_options(cases=list(FAMILIES), draws=None)
