"""Tables of trainings: the main job, speed, the dynamics ratio, randomisation, rounds, and a benchmark of others."""

import math

import numpy as np
import pandas as pd
from cells import NOT_RUN, Runs, number, share
from search_tables import verdict

from torchrl_h2o.comparison import off_dynamics
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.results_file import IDENTITY
from torchrl_h2o.comparison.rounds import rounds_of, rounds_tables
from torchrl_h2o.comparison.seed_table import EPISODE, seed_tables
from torchrl_h2o.comparison.series_tables import series_tables

LONG = 200  # characters of a change that a table cannot show
#: values that make a training another line of the table
SETTINGS = [*(key for key in IDENTITY if key != "seed"), "compiled", "device", "instruction_set"]


# Training
def trainings_of(runs: Runs) -> pd.DataFrame:
    if "training" not in runs:
        return pd.DataFrame(columns=[*SETTINGS, "seconds"])
    told = runs["training"]
    numbers = ["return_mean", "return_data", "seconds", "max_abs_x"]
    return told.assign(**{column: pd.to_numeric(told[column], errors="coerce") for column in numbers})


def training_table(runs: Runs) -> str:
    """A line for each task, method and settings: seeds that stand, return, distance."""
    head = ["task", "method and settings", "processor", "whole episodes", "return", "data's return", "farthest, m"]
    rows = []
    for key, own in trainings_of(runs).groupby(SETTINGS):
        told = dict(zip(SETTINGS, key, strict=True))
        shown = [name for name in ("data", "data_seconds", "gap", "mend", "updates", "others") if told[name]]
        settings = [f"{name} {told[name]}" for name in shown if told[name] != "recorded"]
        is_robot, returns = told["env"].startswith("wheel_legged"), own["return_mean"].dropna()
        spread = f" ± {returns.std():,.0f}" if len(returns) > 1 else ""
        processor = f"{told['device']} {told['instruction_set']}, compiled={told['compiled']}"
        whole = share((own["seconds"] >= EPISODE).sum(), len(own)) if is_robot else f"{len(own)} seeds"
        found = f"{returns.mean():,.0f}{spread}" if len(returns) else "diverged"
        of_data = f"{own['return_data'].mean():,.0f}" if len(returns) else ""
        far = f"{own['max_abs_x'].max():.2f}" if own["max_abs_x"].notna().any() else ""
        last = [number(own["minutes"].mean()), own["commit"].iloc[0]]
        rows.append([told["env"], "; ".join([told["method"], *settings]), processor, whole, found, of_data, far, *last])
    empty = ["wheel_legged/standing_still", "h2o_plus", "", NOT_RUN, *[""] * 5]
    return markdown_table([*head, "CPU min a run", "commit"], rows or [empty])


def by_seed_table(runs: Runs) -> str:
    told = runs.get("training", pd.DataFrame({"env": []}))
    of_robot = told[told["env"].astype(str).str.startswith("wheel_legged")]
    if not len(of_robot):
        return NOT_RUN
    processor = "compiled=" + of_robot["compiled"] + " " + of_robot["instruction_set"]
    return seed_tables(of_robot.astype(str).assign(others=(of_robot["others"] + " " + processor).str.strip()))


def speed_table(runs: Runs) -> str:
    rows = [
        [run["device"], name, f"{rate:,.1f}", run["commit"]]
        for run in (runs["speed"].to_dict("records") if "speed" in runs else ())
        for name, rate in run["updates_per_second"].items()
    ]
    return markdown_table(["device", "what", "updates per second", "commit"], rows or [["", "H2O+", NOT_RUN, ""]])


def ratio_table(runs: Runs) -> str:
    """Means over seeds, a line for each system and estimator."""
    by = ["system", "estimator", "rows", "steps"]
    shown = ["unclamped", "clamped", "ess", "accuracy", "correlation", "slope"]
    rows = []
    for key, own in runs["ratio"].groupby(by) if "ratio" in runs else ():
        means = own.reindex(columns=shown).mean()
        cells = ["" if math.isnan(value) else f"{value:.2f}" for value in means]
        rows.append([*map(str, key), *cells, str(len(own)), own["commit"].iloc[0]])
    head = ["system", "estimator", "simulated rows", "updates", "mean ratio", "clamped", "effective share", *shown[3:]]
    return markdown_table([*head, "seeds", "commit"], rows or [["", "", "", "", NOT_RUN, *[""] * 7]])


# Domain randomisation
WORLDS = ("measured ranges", "± 20 %", "mended", "unmended", "the series itself")
SCORES = ("return", "return in training's worlds", "seconds stood", "tracking error, mm")


def randomization_table(runs: Runs) -> str:
    """For each series of machines, a line for the worlds in which policies were trained, and a sentence."""
    if "randomization" not in runs:
        return NOT_RUN
    told = runs["randomization"]
    return f"{series_tables(told, WORLDS, SCORES)}\n\nCommit {told['commit'].iloc[0]}."


# Rounds between simulator and reality
def rounds_table(runs: Runs) -> str:
    """For each task, the return in reality of each method by round, and how many predictions held."""
    if "sim_to_real" not in runs:
        return NOT_RUN
    told = runs["sim_to_real"]
    return f"{rounds_tables(rounds_of(told))}\n\nCommit {told['commit'].iloc[0]}."


# A benchmark of others
def off_dynamics_table(runs: Runs) -> str:
    """A line for each file: what was found in it, and the scores of the methods."""
    if "off_dynamics" not in runs:
        return NOT_RUN
    searches, trainings = runs["off_dynamics"], runs.get("off_dynamics_runs", pd.DataFrame({"env": [], "updates": []}))
    found = {
        row["file"]: {
            "change": row["change"] if len(row["change"]) < LONG else "thighs, shins and back foot",
            "cause found": row["found"],
            "verdict": verdict({"effects": row["found"], "severe": [], "other_sets": 0, "ended_in": None, **row}),
        }
        for row in searches.to_dict("records")
    }
    commits = f"Searches of commit {searches['commit'].iloc[0]}"
    if len(trainings):
        updates = int(trainings["updates"].iloc[0])
        commits += f", trainings of {trainings['commit'].iloc[0]} after {updates:,} updates"
    return f"{off_dynamics.markdown(off_dynamics.points_of(trainings), found)}\n\n{commits}."


def off_dynamics_errors_table(runs: Runs) -> str:
    """A line for each file: errors one step ahead, and whether rewards and falls are those of Gymnasium's task."""
    if "off_dynamics" not in runs:
        return NOT_RUN
    tasks = ("unmodified", "mended", "changed")
    head = ["file", *(f"z, m/s, {task}" for task in tasks), *(f"joints, rad/s, {task}" for task in tasks)]
    rows = [
        [
            run["file"],
            *(number(run[task][1]) for task in tasks),
            *(number(float(np.median(run[task][3:]))) for task in tasks),
            number(run["reward_error"]),
            str(run["other_terminations"]),
        ]
        for run in runs["off_dynamics"].to_dict("records")
    ]
    return markdown_table([*head, "reward", "other falls, rows"], rows)
