"""The results file: rows that are taken over, and free of the machine's folders."""

import json
import shlex
from concurrent.futures import ThreadPoolExecutor

import pandas as pd
import pytest

from torchrl_h2o.comparison.results_file import (
    CURVE,
    IDENTITY,
    RESULT,
    adopt_runs,
    append_rows,
    append_run,
    identity,
    read_rows,
    repeating_command,
)


def test_a_run_that_another_group_has_done_is_taken_over_with_its_curve(tmp_path):
    who = dict.fromkeys(IDENTITY, "x")
    for name, columns in (("a.csv", (*IDENTITY, *RESULT)), ("a_curves.csv", (*IDENTITY, *CURVE))):
        for whose in (who, who | {"seed": "y"}):
            append_rows(tmp_path / name, pd.DataFrame([dict.fromkeys(columns, "1") | whose]))
    (tmp_path / "notes.csv").write_bytes(b"anybody's\xff, x\n")
    (tmp_path / "empty.csv").touch()
    (tmp_path / "folder.csv").mkdir()
    for _ in range(2):
        adopt_runs(tmp_path / "b.csv", [who, who | {"seed": "z"}])
    assert read_rows(tmp_path / "b.csv")["seed"].tolist() == ["x"]
    assert read_rows(tmp_path / "b_curves.csv")["seed"].tolist() == ["x"]


def test_a_file_with_other_columns_is_left_alone(tmp_path):
    append_rows(tmp_path / "a.csv", pd.DataFrame([dict.fromkeys((*IDENTITY, "notes"), "1")]))
    with pytest.raises(ValueError, match="has the columns"):
        append_rows(tmp_path / "a.csv", pd.DataFrame([dict.fromkeys(IDENTITY, "2")]))
    assert len(read_rows(tmp_path / "a.csv")) == 1


def test_runs_that_end_at_the_same_time_all_get_their_rows(tmp_path):
    rows = [pd.DataFrame([dict.fromkeys(IDENTITY, "x") | {"seed": str(seed)}]) for seed in range(16)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda row: append_rows(tmp_path / "a.csv", row), rows))
    assert set(read_rows(tmp_path / "a.csv")["seed"]) == {str(seed) for seed in range(16)}


@pytest.mark.parametrize(
    ("override", "shown"),
    [
        ("data=/home/me/logs/a.txt", "data=logs/a.txt"),
        ("data=[/home/me/logs/a.txt,/home/me/logs/b.txt]", "data=[logs/a.txt,logs/b.txt]"),
        ("mend='/home/me/outputs/report.json'", "mend='outputs/report.json'"),
        ("data=halfcheetah/medium-v0", "data=halfcheetah/medium-v0"),
    ],
)
def test_results_name_no_folder_of_the_machine(compose, override, shown):
    cfg, _ = compose("method=iql", config="train")
    cfg.overrides = ["method=iql", override]
    assert shlex.split(repeating_command(cfg))[-1] == shown
    assert "/home" not in identity(cfg)["others"]


def test_what_does_not_change_results_does_not_make_another_run(compose):
    cfg, _ = compose("method=iql", config="train")
    found = []
    for overrides in ([], ["threads=1"], ["overlap=true"], ["compiled=false"], ["eval_every=2"]):
        cfg.overrides = ["method=iql", *overrides]
        found.append(identity(cfg)["others"])
    assert found == ["", "", "", "", "eval_every=2"]


@pytest.mark.parametrize(
    ("mend", "mended", "column"),
    [
        (None, None, ""),
        (True, None, "0"),
        (True, {"effects": [{"effect": "Gravity", "scale": 0.5}], "worlds": None}, "1"),
    ],
)
def test_a_run_records_how_many_effects_mending_has_added(compose, tmp_path, mend, mended, column):
    cfg, _ = compose("method=iql", config="train")
    cfg.mend, cfg.mended = mend, mended
    real = {"mean": 1.0, "std": 0.0, "episodes": 1, "mean_length": 2.0}
    summary = {"return_real": real, "return_data": {"mean": 1.0}, "updates_per_second": 1.0, "versions": {}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "metrics.csv").write_text("updates,return_real,return_real_std,length_real\n1,1,0,2\n")
    append_run(tmp_path / "results.csv", cfg, tmp_path)
    assert read_rows(tmp_path / "results.csv")["effects_added"].tolist() == [column]
