"""The tables of the pages in this folder, each a function from the stored runs, by table, to Markdown."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from scipy.stats import binomtest

from torchrl_h2o.comparison import off_dynamics
from torchrl_h2o.comparison.grids import OFF_DYNAMICS_FILES
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.comparison.records import Record
from torchrl_h2o.comparison.results_file import IDENTITY
from torchrl_h2o.comparison.rounds import rounds_of, rounds_tables
from torchrl_h2o.comparison.seed_table import EPISODE, seed_tables
from torchrl_h2o.comparison.series_tables import series_tables

HERE = Path(__file__).parent
NOT_RUN = "not run on this code"
LONG = 200  # characters of a change that a table cannot show
CLOSE = 0.25  # relative error up to which a value counts as right
#: values that make a training another line of the table
SETTINGS = [*(key for key in IDENTITY if key != "seed"), "compiled", "device", "instruction_set"]
Runs = Mapping[str, pd.DataFrame]  # by table, a row for each record


def frame(records: Iterable[Record]) -> pd.DataFrame:
    """Arrange the records of one table as rows: their names, values, commits, processors and CPU minutes."""
    made_by = ("commit", "instruction_set")
    rows = []
    for record in records:
        told = {key: record.made_by[key] or "unknown" for key in made_by}
        rows.append({"run": record.name, **record.values, **told, "minutes": record.made_by["cpu_s"] / 60})
    return pd.DataFrame(rows)


@cache
def machines() -> dict[str, dict[str, Any]]:
    return yaml.safe_load((HERE / "machines.yaml").read_text())


@cache
def drawn_families() -> dict[str, dict[str, Any]]:
    return yaml.safe_load((HERE / "drawn.yaml").read_text())


def share(right: int, of: int) -> str:
    """A number of cases with the 95 % interval of Wilson of their share.

    Example:
        >>> share(9, 10)
        '9 of 10 [60, 98 %]'
    """
    if not of:
        return ""
    low, high = binomtest(int(right), int(of)).proportion_ci(method="wilson")
    return f"{right} of {of} [{100 * low:.0f}, {100 * high:.0f} %]"


def number(value: float) -> str:
    return f"{value:.3g}"


# What it finds
def machines_table(runs: Runs) -> str:
    """A line for each known value of each machine, with what its report says."""
    found = {row["run"]: row for row in runs["machines"].to_dict("records")} if "machines" in runs else {}
    head = ["machine", "known", "found [95 % interval]", "verdict", "CPU min", "commit", "set with this log"]
    rows = []
    for name, machine in machines().items():
        told = [f"{known['what']} {_value(known)} ({known['by']})" for known in machine["known"]]
        set_with = "yes" if machine["set_with"] else "no"
        if name not in found:
            rows.append([machine["machine"], "; ".join(told) or "nothing", NOT_RUN, "", "", "", set_with])
            continue
        run = found[name]
        lines = [[words, _found(run["effects"], known)] for words, known in zip(told, machine["known"], strict=True)]
        if others := _not_known(run["effects"], machine["known"]):
            lines.append(["*besides*" if lines else "nothing", others])
        first, *rest = lines or [["nothing", "nothing"]]
        rows.append([machine["machine"], *first, verdict(run), number(run["minutes"]), run["commit"], set_with])
        rows += [["", *line, "", "", "", ""] for line in rest]
    return markdown_table(head, rows)


def _value(known: Mapping) -> str:
    return f"× {known['value']}" if known["unit"] == "×" else f"{known['value']} {known['unit']}"


def verdict(run: Mapping) -> str:
    """The verdict of a report, in a few words."""
    if run["severe"]:
        return f"severe finding of the audit: {run['severe'][0]}"
    parts = [str(run["verdict"]).replace("_", " ")]
    if run["effects"] and not run["recommended"]:
        parts.append("not recommended")
    if run["other_sets"]:
        parts.append(f"{run['other_sets']} other sets explain the log as well")
    return "; ".join([*parts, *(["time was up"] if run["ended_in"] else [])])


def _matching(effects: Iterable[Mapping], known: Mapping) -> list[Mapping]:
    """The effects of a report that act where a known value does."""

    def acts(effect: Mapping) -> bool:
        chosen = [value for key, value in effect.items() if key != "effect" and isinstance(value, str | list)]
        names = [name for value in chosen for name in ([value] if isinstance(value, str) else value)]
        return "on" not in known or any(fnmatch(str(known["on"]), str(name)) for name in names)

    return [each for each in effects if each["effect"]["effect"] == known.get("effect") and acts(each["effect"])]


def _found(effects: Iterable[Mapping], known: Mapping) -> str:
    if "effect" not in known:
        return "not compared"
    found = [effect["parameters"] for effect in _matching(effects, known)]
    parameters = [entries[known.get("parameter", next(iter(entries)))] for entries in found]
    if not parameters:
        return "not found"
    values = [parameter["value"] for parameter in parameters]
    value = math.prod(values) if known["unit"] == "×" else sum(values)
    interval = parameters[0]["ci95"] if len(parameters) == 1 else None
    error = abs(abs(value) / abs(known["value"]) - 1.0)
    words = number(value) + (f" [{number(interval[0])}, {number(interval[1])}]" if interval else "")
    return f"{words}: {'right' if error <= CLOSE else '**wrong**'}, {100 * error:.0f} % off"


def _not_known(effects: Sequence[Mapping], known: Iterable[Mapping]) -> str:
    compared = [effect for entry in known for effect in _matching(effects, entry)]
    return "; ".join(effect["words"] for effect in effects if effect not in compared)


def sources_table(runs: Runs) -> str:
    told = [(entry, entry.get("command")) for entry in machines().values()]
    rows = [[entry["machine"], entry["source"], f"`{command}`" if command else ""] for entry, command in told]
    return markdown_table(["machine", "source of the log", "command"], rows)


# How often it is right
def _draws(runs: Runs) -> pd.DataFrame:
    """All drawn cases, with the column ``held``: whether nothing was chosen with them, as with all of other seeds."""
    draws = runs.get("drawn", pd.DataFrame(columns=["family", "number", "seed", "ok"]))
    chose = {(family, 0, draw) for family, told in drawn_families().items() for draw in told["chose"]}
    keys = draws[["family", "seed", "number"]].itertuples(index=False, name=None)
    return draws.assign(held=[key not in chose for key in keys])


def drawn_table(runs: Runs) -> str:
    """A line for each family: draws that chose something and draws held back, apart."""
    head = [
        "family",
        "right is",
        "draws held back",
        "draws that chose something",
        "not run",
        "CPU min a draw",
        "commit",
    ]
    rows, draws = [], _draws(runs)
    for name, family in drawn_families().items():
        own = draws[draws["family"] == name]
        held, chose = own.loc[own["held"], "ok"], own.loc[~own["held"].astype(bool), "ok"]
        counts, cost, commit = [NOT_RUN, ""], "", ""
        if len(own):
            counts = [share(part.sum(), len(part)) for part in (held, chose)]
            cost, commit = number(own["minutes"].mean()), own["commit"].iloc[0]
        left = family["draws"] - own.loc[own["seed"] == 0, "number"].nunique()
        rows.append([f"`{name}`", family["right"], *counts, str(left or ""), cost, commit])
    return markdown_table(head, rows)


def audit_table(runs: Runs) -> str:
    head = ["logs", "right", "refused by the reader", "CPU s of the longest audit", "commit"]
    rows = [
        [run["run"].replace("_", " "), share(run["right"], run["logs"]), str(run["refused"] or ""),
         number(run["longest_cpu_s"]), run["commit"]]
        for run in (runs["audit"].to_dict("records") if "audit" in runs else ())
    ]  # fmt: skip
    return markdown_table(head, rows or [["damaged and good logs", NOT_RUN, "", "", ""]])


# Where it fails
def failures_table(runs: Runs) -> str:
    """All draws and logs of the tables above that are wrong, with what was found."""
    draws = _draws(runs)
    rows = [
        [
            f"`{draw['family']}` {draw['number']}, {draw['name']}",
            draw["truth"],
            draw["found"],
            str(draw.get("verdict", "")),
        ]
        for draw in draws[~draws["ok"].astype(bool)].to_dict("records")
    ]
    for run in runs["machines"].to_dict("records") if "machines" in runs else ():
        for known in machines()[run["run"]]["known"]:
            found = _found(run["effects"], known)
            if "wrong" in found or found == "not found":
                told = f"{known['what']} {_value(known)}"
                rows.append([machines()[run["run"]]["machine"], told, found, verdict(run)])
    for run in runs["audit"].to_dict("records") if "audit" in runs else ():
        rows += [[run["run"].replace("_", " "), *wrong.partition(": ")[::2], ""] for wrong in run["wrong"]]
    cases = sum(len(runs[table]) for table in ("drawn", "machines", "audit") if table in runs)
    return markdown_table(["case", "true", "found", "verdict"], rows or [[f"none of {cases}", "", "", ""]])


# Whether its intervals are right
def coverage_table(runs: Runs) -> str:
    """A line for each machine: values of logs that were left out, inside the intervals that its other logs gave."""
    head = [
        "machine",
        "series",
        "values compared",
        "inside",
        "inside, with the log's own interval",
        "true value inside",
    ]
    rows = []
    for machine, own in runs["coverage"].groupby("machine", sort=False) if "coverage" in runs else ():
        sums = own[["asked", "values", "inside", "inside_widened", "truths", "truths_inside"]].sum()
        shares = [share(sums[key], sums["values"]) for key in ("inside", "inside_widened")]
        counted = [str(len(own)), f"{sums['values']} of {sums['asked']}", *shares]
        last = [number(own["minutes"].mean()), own["commit"].iloc[0]]
        rows.append([machine, *counted, share(sums["truths_inside"], sums["truths"]), *last])
    return markdown_table([*head, "CPU min a series", "commit"], rows or [["", "", NOT_RUN, *[""] * 5]])


# Training
def _trainings(runs: Runs) -> pd.DataFrame:
    if "training" not in runs:
        return pd.DataFrame(columns=[*SETTINGS, "seconds"])
    told = runs["training"]
    numbers = ["return_mean", "return_data", "seconds", "max_abs_x"]
    return told.assign(**{column: pd.to_numeric(told[column], errors="coerce") for column in numbers})


def training_table(runs: Runs) -> str:
    """A line for each task, method and settings: seeds that stand, return, distance."""
    head = ["task", "method and settings", "processor", "whole episodes", "return", "data's return", "farthest, m"]
    rows = []
    for key, own in _trainings(runs).groupby(SETTINGS):
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


# The overview
def overview_table(runs: Runs) -> str:
    draws, trainings = _draws(runs), _trainings(runs)
    held, stands = draws.loc[draws["held"], "ok"], trainings["seconds"] >= EPISODE
    stands = stands[trainings["env"].astype(str).str.startswith("wheel_legged")]
    rows = [
        ["machines", "what it finds in logs of machines", f"{len(runs.get('machines', ()))} of {len(machines())} run"],
        ["drawn", "how often it is right", f"{share(held.sum(), len(held))} draws held back" if len(held) else NOT_RUN],
        ["failures", "where it fails", f"{len(draws) - draws['ok'].sum()} of {len(draws)} draws"],
        ["intervals", "whether its intervals are right", _covered(runs)],
        [
            "training",
            "training",
            f"robot stands in {share(stands.sum(), len(stands))} runs" if len(stands) else NOT_RUN,
        ],
        [
            "randomization",
            "whether measured ranges help a policy",
            f"{len(runs['randomization'])} policies" if "randomization" in runs else NOT_RUN,
        ],
        [
            "sim_to_real",
            "rounds between simulator and reality",
            f"{len(runs['sim_to_real'])} runs" if "sim_to_real" in runs else NOT_RUN,
        ],
        ["off_dynamics", "a benchmark of others", _mended_right(runs)],
    ]
    return markdown_table(
        ["page", "what is in it", "now"], [[f"[{page}.md]({page}.md)", *rest] for page, *rest in rows]
    )


def _covered(runs: Runs) -> str:
    if "coverage" not in runs:
        return NOT_RUN
    told = runs["coverage"]
    return f"{share(told['truths_inside'].sum(), told['truths'].sum())} true values inside"


def _mended_right(runs: Runs) -> str:
    if "off_dynamics" not in runs:
        return NOT_RUN
    told = runs["off_dynamics"]
    return f"{told['recommended'].sum()} of {len(told)} simulators mended, {len(OFF_DYNAMICS_FILES)} files"


TABLES: dict[str, Callable[[Runs], str]] = {
    "overview": overview_table,
    "machines": machines_table,
    "sources": sources_table,
    "drawn": drawn_table,
    "audit": audit_table,
    "failures": failures_table,
    "coverage": coverage_table,
    "training": training_table,
    "by_seed": by_seed_table,
    "rounds": rounds_table,
    "speed": speed_table,
    "ratio": ratio_table,
    "randomization": randomization_table,
    "off_dynamics": off_dynamics_table,
    "off_dynamics_errors": off_dynamics_errors_table,
}
