"""Writes a group's table, learning curves and aggregate scores, with the paper's numbers for comparison."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from torchrl_h2o.comparison import off_dynamics
from torchrl_h2o.comparison.aggregates import BASE, Scores, common_scores, improvements, interquartile_means
from torchrl_h2o.comparison.figures import draw_aggregates, draw_curves
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.results_file import curves_of, read_rows
from torchrl_h2o.comparison.scores import VARIANTS, MixedRunsError, Reference, Task, markdown, placed, require_distinct
from torchrl_h2o.comparison.seed_table import seed_tables
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.whole_file import write_text

TITLES = {name: method.title for name, method in METHODS.items()}
SCORES = (
    "Scores are returns scaled so that D4RL's random policy scores 0 and its expert 100. For the robot, a return of 0 "
    "scores 0 and 30 s without a fault scores 100; that scale is ours."
)
ABLATIONS = ("mixing", "backbones")  # groups that compare variants of H2O+


def of_one_budget(runs: pd.DataFrame, updates: int | None, group: str) -> pd.DataFrame:
    """Select the runs trained for one number of updates, so that only equal budgets are compared.

    Raises:
        MixedRunsError: if runs differ in their number of updates and ``updates`` is None.
    """
    budgets = sorted(map(int, runs["updates"].unique()))
    if updates is None and len(budgets) > 1:
        raise MixedRunsError(f"{group}.csv holds runs of {budgets} updates: choose one with updates=...")
    return runs if updates is None else runs[runs["updates"] == str(updates)]


def report(
    group: str,
    runs: pd.DataFrame,
    results: Path,
    to: Path,
    references: Mapping[str, Reference],
    paper: pd.DataFrame,
    reps: int,
) -> None:
    """Write a group's table, learning curves and aggregate scores, and print the table.

    Args:
        group: name of the table or figure.
        runs: rows of its results file, all with the same number of updates.
        results: folder of the results files.
        to: folder to write to.
        references: by environment, the returns with score 0 and score 100.
        paper: the paper's results.
        reps: number of bootstrap samples.

    Raises:
        MixedRunsError: if a method has two runs of a seed in a task.
    """
    table = placed(runs, group in ABLATIONS)
    require_distinct(table)
    theirs = paper_cells(paper, group, set(table["task"]))
    lines = [markdown(table, TITLES, theirs, references), ""]
    lines.append(
        "Returns in reality: mean ± standard deviation over seeds (number of seeds); for one seed, over its episodes."
    )
    kept = "" if runs["others"].str.contains("keep=").any() else ", with the last policy"
    lines.append(f"After {int(runs['updates'].iloc[0]):,} updates{kept}.")
    if theirs:
        lines.append("The paper's results: five seeds, 1,000,000 updates, D4RL's data.")
    lines.append(SCORES)
    (to / f"{group}_aggregates.png").unlink(missing_ok=True)  # it may show earlier runs
    if unknown := sorted(set(table["env"]) - references.keys()):
        lines.append(f"Scores need the returns that score 0 and 100: +references.{unknown[0]}=[...,...].")
    elif table["method"].nunique() > 1:
        num_tasks = table["task"].nunique()
        lines += ["", *aggregate_lines(group, common_scores(table, references), num_tasks, to, reps)]
    _write(to, group, "\n".join(lines) + "\n")
    curves = read_rows(curves_of(results / f"{group}.csv"))
    curves = curves[curves["updates"].isin(set(runs["updates"]))]
    if len(curves):
        draw_curves(to / f"{group}_curves.png", placed(curves, group in ABLATIONS), TITLES)


def report_off_dynamics(runs: pd.DataFrame, to: Path) -> None:
    """Write off_dynamics.md, and print it.

    Args:
        runs: rows of the results file of ``table=off_dynamics``; any part of the grid.
        to: folder to write to.

    Raises:
        MixedRunsError: if two runs differ in settings that the table does not show.
    """
    after = f"After {int(runs['updates'].iloc[0]):,} updates."
    _write(to, "off_dynamics", f"{off_dynamics.markdown(off_dynamics.points_of(runs))}\n\n{after}\n")


def report_seeds(results: Path, group: str, to: Path, at: Sequence[int]) -> None:
    """Write GROUP_by_seed.md, a number per seed and variant, and print it.

    Args:
        results: folder of the results files.
        group: name of the results file.
        to: folder to write to.
        at: numbers of updates, to read the learning curves as well; empty for the final evaluations alone.
    """
    text = seed_tables(read_rows(results / f"{group}.csv"))
    if at:
        text += "\nDuring training:\n\n" + seed_tables(read_rows(curves_of(results / f"{group}.csv")), at)
    _write(to, f"{group}_by_seed", text)


def _write(to: Path, name: str, text: str) -> None:
    to.mkdir(parents=True, exist_ok=True)
    write_text(to / f"{name}.md", text)
    print(f"\n{name.replace('_by_seed', ' by seed')}\n\n{text}")


def aggregate_lines(group: str, scores: Scores, num_tasks: int, to: Path, reps: int) -> list[str]:
    """Draw the aggregate scores and return them as lines of text, or the reason if they cannot be computed."""
    if not scores.tasks:
        return ["Interquartile means need a task that every method has finished."]
    if len(scores.seeds) < 2:
        return ["Interquartile means and their intervals need at least two seeds of every method."]
    means = interquartile_means(scores, reps)
    better = improvements(scores, reps) if BASE in scores.runs else {}
    number = f"{len(scores.tasks)} of {num_tasks} tasks" if len(scores.tasks) < num_tasks else f"{num_tasks} tasks"
    note = f"{number}, seeds {', '.join(map(str, scores.seeds))}; 95 % bootstrap intervals"
    draw_aggregates(to / f"{group}_aggregates.png", means, better, TITLES, note)
    return [aggregate_table(means, better), "", f"{note}."]


def aggregate_table(means: dict, better: dict) -> str:
    """Format interquartile means and probabilities of improvement as a Markdown table, one line per method."""
    head = ["method", "interquartile mean of the normalised score", "P(H2O+ does better)"]
    names = [name for name in TITLES if name in means]
    rows = [[TITLES[name], means[name].text(), better[name].text() if name in better else ""] for name in names]
    return markdown_table(head, rows)


def paper_cells(results: pd.DataFrame, group: str, tasks: set[Task]) -> dict[Task, dict[str, str]]:
    """Format the paper's results for the tasks of a table, as text by task and method.

    Args:
        results: rows of recipes/paper.csv.
        group: name of the table or figure.
        tasks: the tasks of the table.
    """
    cells: dict[Task, dict[str, str]] = {}
    for row in results[results["group"] == group].to_dict("records"):
        asked = (row["env"], row["data"], f"{row['gap']} {float(row['strength']):g}")
        variant = [f"{name} {row[key]}".strip() for key, name in VARIANTS.items() if row.get(key)]
        for task in tasks:
            if task[:3] == asked and all(part in task[3:] for part in variant):
                text = f"{float(row['return_mean']):,.0f} ± {float(row['return_std']):,.0f}"
                cells.setdefault(task, {})[row["method"]] = text
    return cells
