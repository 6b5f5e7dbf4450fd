"""Draws ``figure=data_size``: return in reality and seconds balanced against the seconds of real data."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_h2o.comparison.aggregates import mean_of_runs
from torchrl_h2o.comparison.data_size import TITLES, panels_of
from torchrl_h2o.comparison.figures import save_figure
from torchrl_h2o.comparison.grids import DATA_SIZE_METHODS, MENDED, POSTERIOR, split_suffix
from torchrl_h2o.training.learning_curve import COLOURS
from torchrl_h2o.training.methods import METHODS

LOWEST = -4.0  # returns below are drawn here: a policy that struggles for long can return -100
#: column of the points, label of the axis and its limits, by row of the figure
ROWS = {
    "share": ("return in reality\n(100: 30 s without a fault)", (-7.0, 107.0)),
    "seconds": ("balances in reality (s of 30)", (-2.0, 32.0)),
}


def draw_data_size(path: Path, points: pd.DataFrame, reps: int) -> None:
    """Draw a column of two panels (return, seconds balanced) for each task and kind of real data.

    Args:
        path: PNG file to write.
        points: from :func:`~torchrl_h2o.comparison.data_size.points_of`; panels without runs are left out.
        reps: number of bootstrap samples of the 95 % intervals.
    """
    panels = panels_of(points)
    figure = Figure((3.6 * len(panels) + 0.6, 7.2), layout="constrained")
    axes = figure.subplots(2, len(panels), sharex="col", sharey="row", squeeze=False)
    for column, panel in zip(axes.T, panels, strict=True):
        of_panel = points[points["panel"] == panel]
        for axis, (quantity, (label, limits)) in zip(column, ROWS.items(), strict=True):
            _draw_methods(axis, of_panel, quantity, reps)
            axis.set(ylim=limits, ylabel=label if axis is axes[0, 0] or axis is axes[1, 0] else None)
        column[0].set_title(panel, fontsize=10)
        column[1].set_xlabel("real data (s)")
    handles = {line.get_label(): line for axis in axes.flat for line in axis.get_legend_handles_labels()[0]}
    figure.legend(handles.values(), handles.keys(), frameon=False, loc="outside lower center", ncols=4, fontsize=8)
    counts = points.groupby(["panel", "method", "size"]).size()
    number = f"{counts.min()}" if counts.min() == counts.max() else f"{counts.min()} to {counts.max()}"
    seeds = "seed" if counts.max() == 1 else "seeds"
    figure.suptitle(f"Mean of {number} {seeds}, 95 % bootstrap intervals; returns below 0 are cut off", fontsize=9)
    save_figure(figure, path)


def _draw_methods(axis: Axes, points: pd.DataFrame, quantity: str, reps: int) -> None:
    """Draw one line per method, with its interval at every size."""
    present = [method for method in DATA_SIZE_METHODS if (points["method"] == method).any()]
    for number, method in enumerate(present):
        of_size = points[points["method"] == method].groupby("size")[quantity]
        intervals = [mean_of_runs(values.tolist(), reps) for _, values in of_size]
        at = np.array(list(of_size.groups)) * 1.025 ** (number - (len(present) - 1) / 2)  # beside each other
        style = _style(method)
        means, low, high = np.maximum([(each.value, each.low, each.high) for each in intervals], LOWEST).T
        axis.plot(at, means, label=TITLES[method], **style)
        axis.vlines(at, low, high, color=style["color"], lw=1.2, alpha=0.6)
    axis.set_xscale("log")
    sizes = sorted(points["size"].unique())
    axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axis.minorticks_off()
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


def _style(method: str) -> dict[str, Any]:
    """Line of a method: its colour; dashes and open markers in the mended simulator; dots for SAC."""
    name, suffix = split_suffix(method)
    line, marker, face = {MENDED: ("--", "s", "white"), POSTERIOR: ("-.", "D", "white")}.get(suffix, ("-", "o", None))
    colour = COLOURS.get(METHODS[name].title)
    style = {"color": colour, "ls": ":" if method == "sac" else line, "marker": marker, "ms": 4.5, "lw": 1.6}
    return style if face is None else style | {"mfc": face}
