"""The tables of a fixture of results, and their statistics compared with plain arithmetic."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from torchrl_h2o.comparison.aggregates import common_scores, improvements, interquartile_means
from torchrl_h2o.comparison.figures import draw_curves
from torchrl_h2o.comparison.results_file import IDENTITY, RESULT, append_rows, read_rows
from torchrl_h2o.comparison.scores import REFERENCES, cell, markdown, normalised, placed, require_distinct
from torchrl_h2o.comparison.tables import ABLATIONS, paper_cells

ROOT = Path(__file__).parents[2]
CHEETAH = {"env": "HalfCheetah-v5", "data": "halfcheetah/medium-replay-v0"}


def row(method, seed, value, gap="gravity", **others):
    who = dict.fromkeys((*IDENTITY, *RESULT), "") | CHEETAH | {"updates": "1000", "episodes": "5"}
    strength = {"gravity": "2.0", "friction": "0.3", "": ""}[gap]
    told = {"method": method, "seed": str(seed), "gap": gap, "strength": strength}
    return who | told | {"return_mean": str(value), "return_std": "10.0", "seconds": "50.0"} | others


GAPS = ("gravity", "friction")


def fixture():
    """Three methods, two gaps, three seeds; IQL uses no simulator."""
    rows = []
    for seed in range(3):
        rows.append(row("iql", seed, 1000 + 100 * seed, gap=""))
        for gap, harder in (("gravity", 0), ("friction", 500)):
            rows.append(row("sac", seed, 500 + 100 * seed - harder, gap))
            plus = {"backbone": "expectile", "mixing": "0.1", "ratio": "True"}
            rows.append(row("h2o_plus", seed, 2000 + 100 * seed - harder, gap, **plus))
    return rows


def write(path, rows):
    pd.DataFrame(rows).to_csv(path, index=False)


def table_of(rows, variants=False):
    return placed(pd.DataFrame(rows), variants)


def test_a_cell_is_the_mean_over_seeds_and_a_method_without_simulator_stands_in_every_gap():
    table = table_of(fixture())
    assert {task[2] for task in table["task"]} == {"gravity 2", "friction 0.3"}
    friction = table[[task[2] == "friction 0.3" for task in table["task"]]]
    cells = {name: cell(runs) for name, runs in friction.groupby("method")}
    assert (cells["h2o_plus"], cells["iql"]) == ("1,600 ± 100 (3)", "1,100 ± 100 (3)")
    assert cell(table_of([row("sac", 0, 7)])) == "7 ± 10 (1)"


def test_variants_are_rows_of_their_own_in_an_ablation():
    rows = [row("h2o_plus", 0, 1, mixing="0.1", ratio=ratio) for ratio in ("True", "False")]
    assert table_of(rows, variants=True)["task"].nunique() == 2


def test_only_settings_that_change_the_last_policy_make_another_task():
    assert table_of([row("sac", 0, 1), row("sac", 0, 9, others="lr=0.01")])["task"].nunique() == 2
    often, rarely = (row(name, 0, 1, others=others) for name, others in (("sac", "eval_every=5"), ("h2o_plus", "")))
    assert table_of([often, rarely])["task"].nunique() == 1
    best = row("h2o_plus", 1, 1, others="eval_every=5 keep=best_in_simulator")  # the evaluations choose the policy
    assert table_of([often, best])["task"].nunique() == 2


def test_columns_are_in_the_order_of_the_titles_and_the_paper_stands_below():
    table = table_of(fixture())
    task = sorted(table["task"])[-1]
    text = markdown(table, {"h2o_plus": "H2O+", "sac": "SAC", "cql": "CQL"}, {task: {"sac": "4,513 ± 513"}})
    head, _, *lines = text.splitlines()
    assert head.endswith("| H2O+ | SAC |")
    assert lines[-1].endswith("| paper |  | 4,513 ± 513 |")
    assert lines[-2].endswith("| score | 19.2 | 7.1 |")  # 0 is -280, 100 is 12,135, as in D4RL
    assert lines[-3].endswith("| ours | 2,100 ± 100 (3) | 600 ± 100 (3) |")


@pytest.mark.parametrize(
    ("group", "runs", "figures"),
    [
        (
            "mixing",
            [
                row("h2o_plus", 0, 1, mixing=mixing, ratio=ratio)
                for mixing, ratio in (("0.1", "True"), ("0.1", "False"))
            ],
            {"6,861 ± 268", "5,579 ± 530"},
        ),
        (
            "gaps",
            [row(method, 0, 1, strength=strength) for method in ("h2o", "h2o_plus") for strength in ("1.25", "3.0")],
            {"6,846 ± 572", "6,171 ± 1,209", "7,165 ± 134", "6,135 ± 811"},
        ),
    ],
)
def test_the_paper_s_figures_stand_beside_the_ablations_they_are_of(group, runs, figures):
    tasks = set(table_of(runs, variants=group in ABLATIONS)["task"])
    theirs = paper_cells(read_rows(ROOT / "recipes" / "paper.csv"), group, tasks)
    assert {text for cells_of_task in theirs.values() for text in cells_of_task.values()} == figures
    assert theirs.keys() == tasks


def test_curves_are_the_seeds_mean_and_their_range(tmp_path, saved_figures):
    rows = [row("sac", seed, seed * at, at=str(at)) for seed in (1, 2, 6) for at in (10, 20)]
    draw_curves(tmp_path / "curves.png", table_of(rows), {"h2o_plus": "H2O+", "sac": "SAC"})
    (axis,) = saved_figures[0].axes
    (line,) = axis.lines
    assert line.get_xydata().tolist() == [[10.0, 30.0], [20.0, 60.0]]
    (band,) = axis.collections
    corners = band.get_paths()[0].vertices
    assert [(corners[corners[:, 0] == at, 1].min(), corners[corners[:, 0] == at, 1].max()) for at in (10, 20)] == [
        (10.0, 60.0),
        (20.0, 120.0),
    ]
    assert [text.get_text() for text in saved_figures[0].legends[0].get_texts()] == ["SAC"]


def test_how_long_episodes_last_is_told_where_some_end_early():
    rows = [row("sac", s, 1, seconds=str(10.0 + s)) for s in range(2)] + [row("h2o_plus", 0, 1)]
    lines = markdown(table_of(rows), {"sac": "SAC", "cql": "CQL", "h2o_plus": "H2O+"}, {}).splitlines()
    assert [line for line in lines if "lasts" in line] == ["|  |  |  |  | lasts, s | 10.5 | 50.0 |"]


def test_two_runs_of_a_seed_are_not_taken_for_one():
    rows = [row("h2o_plus", 0, value, mixing=str(value)) for value in (0.1, 0.5)]
    with pytest.raises(ValueError, match=r"h2o_plus has two runs of seed 0 in .* results="):
        require_distinct(table_of(rows))


def test_the_interquartile_mean_is_that_of_the_middle_half():
    scores = common_scores(table_of(fixture()))
    means = interquartile_means(scores, reps=100)
    assert scores.seeds == [0, 1, 2]
    values = sorted(normalised(2000 + 100 * s - h, REFERENCES["HalfCheetah-v5"]) for s in range(3) for h in (0, 500))
    # a quarter of six values is 1.5, so one value is dropped at each end
    assert means["h2o_plus"].value == pytest.approx(np.mean(values[1:-1]))
    assert means["h2o_plus"].low <= means["h2o_plus"].value <= means["h2o_plus"].high
    np.random.seed(7)
    assert interquartile_means(scores, reps=100) == means  # independent of the global generator's state


def test_the_probability_of_improvement_counts_pairs_of_runs():
    rows = [row("h2o_plus", s, v) for s, v in enumerate((1, 4, 5))] + [
        row("sac", s, v) for s, v in enumerate((2, 3, 6))
    ]
    better = improvements(common_scores(table_of(rows)), reps=50)
    assert better["sac"].value == pytest.approx(4 / 9)
    assert 0 <= better["sac"].low <= 4 / 9 <= better["sac"].high <= 1


def test_aggregates_are_of_tasks_and_seeds_that_every_method_has():
    rows = [r for r in fixture() if (r["method"], r["gap"]) != ("sac", "friction")]
    rows = [r for r in rows if (r["method"], r["seed"]) != ("iql", "2")]
    scores = common_scores(table_of(rows))
    assert [task[2] for task in scores.tasks] == ["gravity 2"]
    assert scores.seeds == [0, 1]
    assert {x.shape for x in scores.runs.values()} == {(2, 1)}


def test_a_method_that_has_done_little_does_not_take_tasks_from_the_others():
    scores = common_scores(table_of([*fixture(), row("td3", 0, 5)]))
    assert len(scores.tasks) == 2
    assert "td3" not in scores.runs
    scores = common_scores(table_of([*fixture(), *(row("td3", s, 5, g) for s in range(3) for g in GAPS)]))
    assert scores.runs["td3"].shape == (3, 2)
    scores = common_scores(table_of([*fixture(), *(row("td3", 0, 5, g) for g in GAPS)]))
    assert scores.seeds == [0, 1, 2]
    assert "td3" not in scores.runs


def test_runs_that_count_in_several_gaps_are_drawn_anew_together():
    scores = common_scores(table_of(fixture()))
    assert scores.runs["iql"].shape == (3, 1)
    both = interquartile_means(scores, reps=200)["iql"]
    once = [r for r in fixture() if r["gap"] != "friction"]
    alone = interquartile_means(common_scores(table_of(once)), reps=200)["iql"]
    values = [normalised(1000 + 100 * seed, REFERENCES["HalfCheetah-v5"]) for seed in range(3)]
    assert both.value == pytest.approx(values[1])
    assert (both.low, both.high) == pytest.approx((values[0], values[2]))
    assert (alone.low, alone.high) == pytest.approx((values[0], values[2]))


@pytest.mark.slow
def test_one_command_makes_tables_and_pictures(tmp_path):
    write(tmp_path / "returns.csv", fixture())
    curve = [
        {**{k: r[k] for k in IDENTITY}, "at": at, "return_mean": at, "return_std": 1}
        for r in fixture()
        for at in (500, 1000)
    ]
    write(tmp_path / "returns_curves.csv", curve)
    command = [sys.executable, str(ROOT / "recipes" / "report.py"), f"results={tmp_path}", "reps=50"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "returns.md").read_text()
    assert "| ours | 600 ± 100 (3) | 1,100 ± 100 (3) | 2,100 ± 100 (3) |" in table
    assert "| paper | 4,513 ± 513 | 5,207 ± 149 | 6,861 ± 268 |" in table
    assert "P(H2O+ does better)" in table
    assert table in done.stdout
    for name in ("returns_curves.png", "returns_aggregates.png"):
        assert (tmp_path / name).stat().st_size > 10_000


@pytest.mark.slow
def test_one_seed_has_no_intervals(tmp_path):
    write(tmp_path / "returns.csv", [r for r in fixture() if r["seed"] == "0"])
    command = [sys.executable, str(ROOT / "recipes" / "report.py"), f"results={tmp_path}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "need at least two seeds" in (tmp_path / "returns.md").read_text()
    assert not (tmp_path / "returns_aggregates.png").exists()


@pytest.mark.slow
def test_runs_of_several_budgets_are_not_set_beside_each_other(tmp_path):
    write(tmp_path / "returns.csv", [row("sac", 0, 1), row("sac", 1, 1, updates="2000")])
    write(tmp_path / "methods.csv", [row("sac", 0, 1)])
    command = [sys.executable, str(ROOT / "recipes" / "report.py"), f"results={tmp_path}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "holds runs of [1000, 2000] updates: choose one" in done.stderr
    assert not (tmp_path / "returns.md").exists()
    assert (tmp_path / "methods.md").exists()


@pytest.mark.slow
def test_a_task_of_one_s_own_is_scored_by_returns_of_its_own(tmp_path):
    (tmp_path / "methods_aggregates.png").write_text("of other runs")
    write(tmp_path / "methods.csv", [r | {"env": "Hopper-v5"} for r in fixture()])
    command = [
        sys.executable,
        str(ROOT / "recipes" / "report.py"),
        f"results={tmp_path}",
        "groups=[methods]",
        "reps=50",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "+references.Hopper-v5=" in (tmp_path / "methods.md").read_text()
    assert not (tmp_path / "methods_aggregates.png").exists()
    done = subprocess.run([*command, "+references.Hopper-v5=[600,2600]"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "|  |  |  |  | score | 0.0 | 25.0 | 75.0 |" in (tmp_path / "methods.md").read_text()
    assert (tmp_path / "methods_aggregates.png").stat().st_size > 10_000


def test_a_run_is_recorded_once(tmp_path):
    for value in (1, 2):
        append_rows(tmp_path / "a.csv", pd.DataFrame([dict.fromkeys(IDENTITY, "x") | {"return_mean": value}]))
    assert read_rows(tmp_path / "a.csv")["return_mean"].tolist() == ["1"]
