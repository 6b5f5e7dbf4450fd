"""Pictures of a report as SVG whose colours are variables of the page.

They are small, so that a grid of them also fits on a phone.
"""

import html
import math
import re
from collections.abc import Sequence
from io import StringIO
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from torchrl_h2o.residuals.report.contents import Interval
from torchrl_h2o.residuals.report.errors import DimensionError, HorizonError
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.windows import ShownWindow, WindowQuantity
from torchrl_h2o.residuals.report.words import number

# placeholder colours, and the page variables that replace them
_INK, _MUTED, _SHADE, _FLOOR, _ASIDE = "#010101", "#020202", "#030303", "#040404", "#050505"
_VARIABLES = {_INK: "--ink", _MUTED: "--muted", _SHADE: "--shade", _FLOOR: "--floor", _ASIDE: "--aside"}
# points are drawn as an image with fixed colours, which are legible on light and dark pages
BEFORE, AFTER = "#d9730d", "#2a7de1"
LINES = ("#2a7de1", "#d9730d", "#1f9d6b", "#a44bd3", "#c2334d")

_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",  # makes the page reproducible
    "text.parse_math": False,  # column names may contain a dollar sign
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.unicode_minus": True,
    **dict.fromkeys(("text.color", "axes.titlecolor"), _INK),
    **dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _MUTED),
}


def error_bars(dimensions: Sequence[DimensionError]) -> str:
    """Draws the errors before and after, and the floor, of dimensions with the same unit on a logarithmic scale."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _figure(height=0.75 + 0.42 * len(dimensions))
        rows = np.arange(len(dimensions))
        floors = [_positive(dimension.floor) for dimension in dimensions]
        axes.barh(rows - 0.18, [_positive(d.before) for d in dimensions], 0.34, color=BEFORE)
        axes.barh(rows + 0.18, [_positive(d.after) for d in dimensions], 0.34, color=AFTER)
        axes.vlines(floors, rows - 0.4, rows + 0.4, color=_FLOOR, linewidth=2)
        axes.set_yticks(rows, [dimension.name for dimension in dimensions], color=_INK)
        axes.invert_yaxis()
        _log_scale(axes, "x", [v for d, f in zip(dimensions, floors, strict=True) for v in (d.before, d.after, f)])
        axes.set_xlabel(f"error, {_unit(dimensions[0].unit)}")
        return _svg(figure, f"error before and after, {_unit(dimensions[0].unit)}")


def horizon_lines(horizons: Sequence[HorizonError], dimension: DimensionError) -> str:
    """Draws the error of one dimension against the prediction horizon."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _figure()
        horizons = [horizon for horizon in horizons if dimension.name in horizon.before]
        seconds = [horizon.seconds for horizon in horizons]
        drawn = []
        for errors, colour in (("before", BEFORE), ("after", AFTER)):
            values = [_positive(getattr(horizon, errors).get(dimension.name)) for horizon in horizons]
            axes.plot(seconds, values, "o-", color=colour, markersize=3.5, linewidth=1.8)
            drawn += values
        _log_scale(axes, "y", drawn)
        axes.set_title(f"{dimension.name} ({_unit(dimension.unit)})")
        axes.set_xlabel("predicted ahead (s)")
        return _svg(figure, f"error of {dimension.name} against the horizon")


def window_lines(window: ShownWindow, quantity: WindowQuantity) -> str:
    """Draws one quantity in a window: measured, and simulated before and after the effects are put in."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _figure(height=2.1)
        axes.plot(window.ahead, quantity.measured, "o", color=_INK, markersize=3.0, mew=0, zorder=3)
        for values, colour in ((quantity.before, BEFORE), (quantity.after, AFTER)):
            axes.plot(window.ahead, values, "-", color=colour, linewidth=1.8)
        axes.set_ylim(*_frame(quantity))
        _plain_ticks(axes)
        axes.set_title(f"{quantity.name} ({_unit(quantity.unit)})")
        axes.set_xlabel("time since the start of the window (s)")
        return _svg(figure, f"{quantity.name}, measured and simulated, in the {window.rank} window")


def _frame(quantity: WindowQuantity) -> tuple[float, float]:
    """Limits that show the measured values and the simulation with the effects, but not all of one that diverges."""
    measured, simulated = np.array(quantity.measured), np.array([*quantity.before, *quantity.after])
    low, high = measured.min(), measured.max()
    simulated = simulated[np.isfinite(simulated)]
    reach = 10.0 * max(high - low, 1e-9 + 1e-3 * np.abs(measured).max())
    shown = np.concatenate([measured, np.clip(simulated, low - reach, high + reach)])
    margin = 0.06 * (np.ptp(shown) or 1.0)
    return float(shown.min() - margin), float(shown.max() + margin)


def motions_in_time(
    times: np.ndarray, lines: np.ndarray, name: str, unit: str, marked: Sequence[tuple[float, float]]
) -> str:
    """Draws a quantity over time, a line each of ``lines``, (K, T), with marked spans of time."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _figure()
        for begin, end in marked:
            axes.axvspan(begin, end, color=_ASIDE, linewidth=0)
        for index, line in enumerate(lines):
            axes.plot(times, line, color=LINES[index % len(LINES)], linewidth=1.3)
        axes.set(xlabel="time, s", title=f"{name}, {_unit(unit)}", xlim=(times[0], times[-1]))
        _plain_ticks(axes)
        return _svg(figure, f"{name} over time, {_unit(unit)}")


def residual_in_time(trace: ResidualTrace, dimension: int, aside: Sequence[Interval] = ()) -> str:
    """Draws the residual of one dimension over time; held-out and excluded intervals are shaded."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _figure()
        span = {"transform": axes.get_xaxis_transform(), "linewidth": 0}
        axes.fill_between(trace.time, 0, 1, where=trace.held_out, step="mid", color=_SHADE, **span)
        for interval in aside:
            axes.axvspan(interval.start, interval.end, color=_ASIDE, linewidth=1)
        _points(axes, trace.time, trace, dimension, framed=_fitted(trace, aside))
        if len(trace.time) > 1:
            axes.set_xlim(trace.time[0], trace.time[-1] or 1.0)
        axes.set_xlabel("time (s)")
        return _svg(figure, f"residual of {trace.names[dimension]} in time")


def residual_against_state(trace: ResidualTrace, dimension: int, state: int, aside: Sequence[Interval] = ()) -> str:
    """Draws the residual of one dimension against one state, without excluded intervals."""
    with matplotlib.rc_context(_STYLE):
        figure, axes = _figure()
        fitted = _fitted(trace, aside)
        states = np.where(fitted, trace.states[:, state], np.nan)
        _points(axes, states, trace, dimension, framed=fitted)
        axes.set_xlabel(f"{trace.names[state]} ({_unit(trace.units[state])})")
        return _svg(figure, f"residual of {trace.names[dimension]} against {trace.names[state]}")


def telling_pairs(trace: ResidualTrace, pictures: int = 12) -> list[tuple[int, int]]:
    """Selects, for each state, the dimensions whose residual before depends on it most.

    Args:
        trace: the residual.
        pictures: approximate number of pairs; there is at least one per state.

    Returns:
        Pairs (dimension, state), ordered by state.
    """
    n = len(trace.names)
    each = min(n, max(1, pictures // max(n, 1)))
    pairs = []
    for state in range(n):
        explained = [_explained(trace.states[:, state], trace.before[:, dimension]) for dimension in range(n)]
        pairs += [(int(dimension), state) for dimension in np.argsort(explained, kind="stable")[::-1][:each]]
    return pairs


def _explained(state: np.ndarray, residual: np.ndarray, groups: int = 12) -> float:
    """Share of the residual's variance that is explained by its means over groups of similar states."""
    finite = np.isfinite(state) & np.isfinite(residual)
    state, residual = state[finite], residual[finite]
    if len(residual) < 4 * groups or residual.std() == 0.0 or state.std() == 0.0:
        return 0.0
    parts = np.array_split(residual[np.argsort(state, kind="stable")], groups)
    return 1.0 - sum(len(part) * part.var() for part in parts) / (len(residual) * residual.var())


def _fitted(trace: ResidualTrace, aside: Sequence[Interval]) -> np.ndarray:
    """Mask, (T,), of the rows outside the excluded intervals."""
    fitted = np.ones(len(trace.time), dtype=bool)
    for interval in aside:
        fitted &= (trace.time < interval.start) | (trace.time > interval.end)
    return fitted


def _points(axes: Axes, x: np.ndarray, trace: ResidualTrace, dimension: int, framed: np.ndarray) -> None:
    """Draws points as an image, to keep the file small; the axis range covers the framed rows without outliers."""
    for residual, colour in ((trace.before, BEFORE), (trace.after, AFTER)):
        axes.plot(x, residual[:, dimension], ".", color=colour, alpha=0.6, markersize=3, mew=0, rasterized=True)
    sizes = np.abs([trace.before[framed, dimension], trace.after[framed, dimension]])
    sizes = sizes[np.isfinite(sizes)]
    limit = 1.5 * np.quantile(sizes, 0.99) if len(sizes) else 0.0
    axes.set_ylim(*((-limit, limit) if limit > 0.0 else (-1.0, 1.0)))
    axes.axhline(0.0, color=_MUTED, linewidth=0.6)
    _plain_ticks(axes)
    axes.set_title(f"residual of {trace.names[dimension]} ({_unit(trace.units[dimension])})")


def _plain_ticks(axes: Axes) -> None:
    """Sets few ticks in plain numbers on both axes."""
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 4)))


def _figure(width: float = 4.0, height: float = 2.4) -> tuple[Figure, Axes]:
    """A figure outside pyplot's registry; sizes in inches."""
    figure = Figure((width, height), layout="constrained")
    figure.patch.set_alpha(0.0)
    axes = figure.subplots()
    axes.patch.set_alpha(0.0)
    return figure, axes


def _log_scale(axes: Axes, name: Literal["x", "y"], values: Sequence[float | None]) -> None:
    """Sets a logarithmic scale around the values, with ticks in plain numbers."""
    finite = [value for value in map(_positive, values) if np.isfinite(value)]
    low, high = (min(finite), max(finite)) if finite else (0.1, 1.0)
    axes.set(**{f"{name}scale": "log", f"{name}lim": (low / 2.0, high * 1.5)})
    axis = getattr(axes, f"{name}axis")
    decades = np.log10(high / low) + 0.5
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2 else (1.0,), numticks=6))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axis.set_minor_locator(NullLocator())
    axes.grid(axis=name, color=_SHADE, linewidth=0.8)
    axes.set_axisbelow(True)


def _positive(value: float | None) -> float:
    """The value, or NaN, which is not drawn, if it is not positive."""
    return float(value) if value is not None and 0.0 < value < math.inf else math.nan


def _unit(unit: str) -> str:
    return "no unit" if unit in ("", "1") else unit


def _svg(figure: Figure, label: str) -> str:
    """The figure as an SVG element for an HTML page, with a label for screen readers."""
    file = StringIO()
    figure.savefig(file, format="svg", dpi=160, metadata={"Date": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)  # ids would repeat on the page, and nothing refers to them
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    return text.replace("<svg ", f'<svg role="img" aria-label="{html.escape(label)}" ', 1)
