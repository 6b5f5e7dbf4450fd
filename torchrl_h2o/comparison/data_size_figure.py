"""Draws ``figure=data_size``: return in reality and seconds balanced against the seconds of real data."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_h2o.comparison.aggregates import Interval, mean_of_runs
from torchrl_h2o.comparison.data_size import FAULTLESS, FORWARD, POOR, REAL_LOG, STANDING, TITLES, Points, Run
from torchrl_h2o.comparison.data_size_grid import MENDED, METHODS, POSTERIOR, SIZES, split_suffix
from torchrl_h2o.training.learning_curve import COLOURS
from torchrl_h2o.training.methods import METHODS as ALL_METHODS
from torchrl_h2o.whole_file import whole_file

LINES, DOTS = (STANDING, FORWARD), (POOR, REAL_LOG)
WIDTHS = {STANDING: 3.0, FORWARD: 2.4}
LOWEST = -4.0  # returns below are drawn here: a policy that struggles for long can return -100
LIMITS = (-7.0, 107.0)
ROOM = 6.5  # the x axis ends at this multiple of the largest size; the labels are in between
GAP = 5.5  # between labels, in % of a faultless episode


def draw_data_size(path: Path, points: Points, reps: int) -> None:
    """Draw a column of two panels per task (return, seconds balanced), and a panel per further kind of real data.

    Args:
        path: PNG file to write.
        points: from :func:`~torchrl_h2o.comparison.data_size.points_of`; panels without runs are left out.
        reps: number of bootstrap samples of the 95 % intervals.
    """
    lines, dots = [name for name in LINES if name in points], [name for name in DOTS if name in points]
    widths = [*(WIDTHS[name] for name in lines), *[2.2] * bool(dots)]
    figure = Figure((1.9 * sum(widths) + 0.6, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, len(widths), width_ratios=widths)
    for column, panel in enumerate(lines):
        value, seconds = figure.add_subplot(grid[0, column]), figure.add_subplot(grid[1, column])
        _draw_lines(value, points[panel], lambda run, panel=panel: _share(run, panel), reps)
        _draw_lines(seconds, points[panel], lambda run: run.seconds / 0.3, reps)
        value.set_title(panel, fontsize=10)
        seconds.set_xlabel("real data (s)")
        seconds.set_yticks(np.arange(0, 101, 20), [f"{0.3 * share:g}" for share in range(0, 101, 20)])
        if column == 0:
            value.set_ylabel("return in reality\n(100: 30 s without a fault)")
            seconds.set_ylabel("balances in reality (s of 30)")
    for row, panel in enumerate(dots):
        axis = figure.add_subplot(grid[row, -1])
        _draw_dots(axis, points[panel], panel, reps)
    counts = sorted({len(runs) for methods in points.values() for sizes in methods.values() for runs in sizes.values()})
    number = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    title = f"Mean of {number} seed{'s' * (counts[-1] > 1)}, 95 % bootstrap intervals; returns below 0 are cut off"
    figure.suptitle(title, fontsize=9)
    with whole_file(path) as partial:
        figure.savefig(partial, dpi=130)


def _share(run: Run, panel: str) -> float:
    """Return of a run in % of a faultless episode."""
    return 100.0 * run.value / FAULTLESS[panel]


def _draw_lines(axis: Axes, methods: Mapping[str, Mapping[float, Sequence[Run]]], value, reps: int) -> None:
    """Draw one line per method with its interval at every size, and its name at the end of the line."""
    ends = {}
    present = [method for method in METHODS if method in methods]
    for number, method in enumerate(present):
        sizes = sorted(methods[method])
        intervals = [mean_of_runs([value(run) for run in methods[method][size]], reps) for size in sizes]
        means = np.maximum([interval.value for interval in intervals], LOWEST)
        at = np.array(sizes) * 1.025 ** (number - (len(present) - 1) / 2)  # beside each other, not on top
        style = _style(method)
        axis.plot(at, means, **style)
        if method == "sac":  # one set of runs, repeated at every size
            low, high = np.clip(_ends(intervals[0]), LOWEST, None)
            axis.fill_between(at, low, high, color=style["color"], alpha=0.12, lw=0)
        else:
            for x, interval in zip(at, intervals, strict=True):
                axis.plot([x, x], np.clip(_ends(interval), LOWEST, None), color=style["color"], lw=1.2, alpha=0.6)
        ends[method] = (at[-1], means[-1])
    _label(axis, ends)
    sizes = sorted({size for sizes in methods.values() for size in sizes} | {SIZES[0], SIZES[-1]})
    axis.set(xscale="log", xlim=(sizes[0] / 1.4, sizes[-1] * ROOM), ylim=LIMITS)
    axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axis.minorticks_off()
    axis.grid(alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)


def _style(method: str) -> dict[str, Any]:
    """Line of a method: its colour; dashes and open markers in the mended simulator; SAC without markers."""
    name, suffix = split_suffix(method)
    colour = COLOURS.get(ALL_METHODS[name].title)
    if suffix:
        line, marker = {MENDED: ("--", "s"), POSTERIOR: ("-.", "D")}[suffix]
        return {"color": colour, "ls": line, "marker": marker, "ms": 5, "mfc": "white", "lw": 1.6}
    if method == "sac":
        return {"color": colour, "ls": ":", "lw": 2.0}
    return {"color": colour, "ls": "-", "marker": "o", "ms": 4.5, "lw": 1.6}


def _ends(interval: Interval) -> list[float]:
    return [interval.low, interval.high]


def _label(axis: Axes, ends: Mapping[str, tuple[float, float]]) -> None:
    """Write each method's name beside the end of its line, moved apart where lines end close together."""
    heights = spread([y for _, y in ends.values()], GAP, LIMITS)
    right = max(x for x, _ in ends.values())
    for (method, (x, y)), height in zip(ends.items(), heights, strict=True):
        colour = _style(method)["color"]
        axis.plot([x, right * 1.12, right * 1.3], [y, y, height], color=colour, lw=0.6, alpha=0.6)
        axis.text(right * 1.36, height, TITLES[method], color=colour, fontsize=8, va="center")


def spread(values: Sequence[float], gap: float, limits: tuple[float, float]) -> list[float]:
    """Move values apart to at least ``gap``, in their order, within limits and as little as a simple sweep allows.

    Args:
        values: positions.
        gap: smallest difference of the new positions.
        limits: lowest and highest new position; they must have room for all.

    Example:
        >>> spread([100.0, 100.0, 0.0], gap=5.0, limits=(0.0, 100.0))
        [95.0, 100.0, 0.0]
    """
    order = np.argsort(values, kind="stable")
    placed = np.array(values, dtype=float)[order]
    for i in range(1, len(placed)):
        placed[i] = max(placed[i], placed[i - 1] + gap)
    highest = limits[1]
    for i in range(len(placed) - 1, -1, -1):
        placed[i] = min(placed[i], highest)
        highest = placed[i] - gap
    moved = np.empty_like(placed)
    moved[order] = placed
    return moved.tolist()


def _draw_dots(axis: Axes, methods: Mapping[str, Mapping[float, Sequence[Run]]], panel: str, reps: int) -> None:
    """Draw one line per method from top to bottom: return with its interval, and the seconds balanced as text."""
    present = [method for method in METHODS if method in methods][::-1]
    for height, method in enumerate(present):
        (runs,) = methods[method].values()
        interval = mean_of_runs([_share(run, panel) for run in runs], reps)
        style: dict[str, Any] = {"marker": "o", **_style(method), "ls": "-"}
        axis.plot(np.clip(_ends(interval), LOWEST, None), [height] * 2, color=style["color"], lw=1.6, alpha=0.6)
        axis.plot(max(interval.value, LOWEST), height, **style)
        axis.text(113, height, f"{np.mean([run.seconds for run in runs]):.1f} s", fontsize=8, va="center")
    (size,) = {size for sizes in methods.values() for size in sizes}
    axis.set_yticks(range(len(present)), [TITLES[method] for method in present], fontsize=8)
    axis.set(xlim=LIMITS, ylim=(-0.6, len(present) - 0.4), xlabel="return in reality; at the right, seconds balanced")
    axis.set_title(f"{panel}, {size:g} s", fontsize=10)
    axis.grid(axis="x", alpha=0.25)
    axis.spines[["top", "right"]].set_visible(False)
