"""Draws learning curves with bands over seeds, and aggregate scores with their intervals."""

import math
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from torchrl_h2o.comparison.aggregates import Interval
from torchrl_h2o.training.learning_curve import COLOURS
from torchrl_h2o.whole_file import whole_file


def draw_curves(path: Path, rows: pd.DataFrame, titles: Mapping[str, str]) -> None:
    """Draw return against updates, one panel per task: mean over seeds, and a band from the lowest to the highest seed.

    Args:
        path: PNG file to write.
        rows: one per evaluation, from :func:`~torchrl_h2o.comparison.scores.placed`.
        titles: titles of the methods, in the order of the legend.
    """
    tasks = sorted(rows["task"].unique())
    columns = min(4, len(tasks))
    lines = math.ceil(len(tasks) / columns)
    figure = Figure((4.2 * columns, 3.2 * lines), layout="constrained")
    sharey = len({task[0] for task in tasks}) == 1  # returns of different environments have different scales
    axes = figure.subplots(lines, columns, squeeze=False, sharey=sharey)
    for axis, task in zip(axes.flat, tasks, strict=False):
        of_task = rows[rows["task"] == task]
        for name in [name for name in titles if (of_task["method"] == name).any()]:
            _draw_band(axis, of_task[of_task["method"] == name], titles[name])
        env, data, *variant = task
        axis.set_title("\n".join(filter(None, [f"{env} {data}".strip(), " ".join(filter(None, variant))])), fontsize=8)
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes.flat[len(tasks) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("updates")
    for axis in axes[:, 0]:
        axis.set_ylabel("return in reality")
    handles = {label: handle for a in axes.flat for handle, label in zip(*a.get_legend_handles_labels(), strict=True)}
    labels = [title for title in titles.values() if title in handles]
    legend = {"frameon": False, "loc": "outside lower center", "ncols": len(labels), "fontsize": 8}
    figure.legend([handles[label] for label in labels], labels, **legend)
    title = "The policy at each evaluation during training;\nbands from the lowest seed to the highest"
    figure.suptitle(title, fontsize=8)
    save_figure(figure, path)


def _draw_band(axis: Axes, rows: pd.DataFrame, title: str) -> None:
    curve = rows.groupby("at")["return_mean"].agg(["mean", "min", "max"])
    colour = COLOURS.get(title)
    axis.plot(curve.index, curve["mean"], color=colour, label=title, lw=1.5)
    axis.fill_between(curve.index, curve["min"], curve["max"], color=colour, alpha=0.2, lw=0)


def draw_aggregates(
    path: Path,
    means: Mapping[str, Interval],
    better: Mapping[str, Interval],
    titles: Mapping[str, str],
    note: str,
) -> None:
    """Draw interquartile means and the probability that H2O+ has the higher score, each with its 95 % interval.

    Args:
        path: PNG file to write.
        means: interquartile mean by method.
        better: probability that H2O+ has the higher score, by the method it is compared with.
        titles: titles of the methods, from top to bottom.
        note: title of the figure, with its tasks and seeds.
    """
    figure = Figure((9, 0.45 * len(means) + 1.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_intervals(left, means, titles)
    left.set(xlabel="interquartile mean of the normalised score", xlim=(min(0.0, left.get_xlim()[0]), None))
    _draw_intervals(right, better, titles)
    right.axvline(0.5, color="0.6", ls="--", lw=1)
    right.set(xlabel="P(H2O+ does better)", xlim=(-0.02, 1.02))
    figure.suptitle(note, fontsize=9)
    save_figure(figure, path)


def _draw_intervals(axis: Axes, intervals: Mapping[str, Interval], titles: Mapping[str, str]) -> None:
    names = [name for name in titles if name in intervals][::-1]
    for height, name in enumerate(names):
        interval, colour = intervals[name], COLOURS.get(titles[name])
        axis.barh(height, interval.high - interval.low, left=interval.low, height=0.5, color=colour, alpha=0.4)
        axis.plot([interval.value] * 2, [height - 0.25, height + 0.25], color=colour, lw=2)
    axis.set_yticks(range(len(names)), [titles[name] for name in names])
    axis.grid(axis="x", alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=130)
