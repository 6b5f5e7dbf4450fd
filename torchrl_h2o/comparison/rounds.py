"""Rounds between simulator and reality of several methods and seeds: a table and a figure of the returns in reality."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from torchrl_h2o.comparison.figures import save_figure
from torchrl_h2o.comparison.markdown import markdown_table
from torchrl_h2o.training.methods import METHODS


def rounds_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Arranges stored runs of sim_to_real.py as a row per round, with the names of task and method.

    Args:
        runs: a row per run, with ``env``, ``gap``, ``method``, ``mend``, ``randomise``, ``seed`` and ``rounds``.

    Example:
        >>> told = {"env": "robot", "gap": None, "method": "sac", "mend": False, "randomise": 0.2, "seed": 0}
        >>> one = {"seconds": 2.5, "measured": 10.0, "inside": True}
        >>> rounds_of(pd.DataFrame([told | {"rounds": [one]}])).to_dict("records")[0]["method"]
        'SAC, ± 20 %'
    """
    rows = []
    for run in runs.to_dict("records"):
        task = " ".join(filter(None, [run["env"], run["gap"]]))
        title = METHODS[run["method"]].title.removesuffix(" in the simulator")
        how = ", mended" if run["mend"] else f", ± {100 * run['randomise']:.0f} %" if run["randomise"] else ""
        for number, one in enumerate(run["rounds"], 1):
            rows.append({"task": task, "method": title + how, "seed": run["seed"], "round": number, **one})
    return pd.DataFrame(rows)


def rounds_tables(rounds: pd.DataFrame) -> str:
    """Formats the median return in reality over seeds, a table for each task, a line per method, a column per round."""
    parts = []
    for task, of_task in rounds.groupby("task"):
        numbers = sorted(of_task["round"].unique())
        lines = []
        for method, own in of_task.groupby("method"):
            medians = own.groupby("round")["measured"].median()
            cells = ["" if math.isnan(one) else f"{one:,.0f}" for one in medians.reindex(numbers)]
            inside = f"{own['inside'].sum()} of {len(own)}"
            lines.append([str(method), *cells, f"{own['seconds'].max():.1f}", inside, str(own["seed"].nunique())])
        head = ["method", *(f"round {number}" for number in numbers), "reality used, s", "predicted", "seeds"]
        parts += [f"**{task}**", markdown_table(head, lines)]
    return "\n\n".join(parts)


def draw_rounds_of_methods(path: Path, rounds: pd.DataFrame) -> None:
    """Draws the returns in reality over the seconds of reality used, a panel per task: a line per seed and method."""
    tasks = sorted(rounds["task"].unique())
    figure = Figure((5.2 * len(tasks), 3.8), layout="constrained")
    for axis, task in zip(figure.subplots(1, len(tasks), squeeze=False).flat, tasks, strict=True):
        of_task = rounds[rounds["task"] == task]
        for number, (method, own) in enumerate(of_task.groupby("method")):
            for index, (_, of_seed) in enumerate(own.groupby("seed")):
                label = str(method) if index == 0 else None
                axis.plot(of_seed["seconds"], of_seed["measured"], "o-", ms=3, lw=1, color=f"C{number}", label=label)
        axis.set(title=task, xlabel="reality used, s", ylabel="return in reality, one run of 10 s")
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=7)
    save_figure(figure, path)
