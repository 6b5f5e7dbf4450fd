"""Pictures of a report as SVG whose colours are variables of the page.

They are small, so that a grid of them also fits on a phone.
"""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np

from torchrl_h2o.residuals.report.contents import Interval
from torchrl_h2o.residuals.report.errors import DimensionError, HorizonError
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.windows import ShownWindow, WindowQuantity
from torchrl_h2o.residuals.report.words import number

# sizes in the units of the pictures, of which 800 are a picture's width
WIDTH, HEIGHT, LETTER = 800, 480, 12
SERIES = ("before", "after")
Range = tuple[float, float]


def error_bars(dimensions: Sequence[DimensionError]) -> str:
    """Draws the errors before and after, and the floor, of dimensions with the same unit on a logarithmic scale."""
    unit = _unit(dimensions[0].unit)
    values = [value for d in dimensions for value in (d.before, d.after, d.floor)]
    widest = 24 + LETTER * max(len(dimension.name) for dimension in dimensions)
    picture = _Picture(
        _log_range(values), (len(dimensions) - 0.5, -0.5), height=150 + 84 * len(dimensions), left=min(widest, 400)
    )
    picture.ticks_below(_log_ticks(picture.x))
    for row, dimension in enumerate(dimensions):
        picture.text(picture.left - 12, picture.down(row) + 6, dimension.name, "end", "--ink")
        for errors, offset in zip(SERIES, (-0.35, 0.0), strict=True):
            if (value := getattr(dimension, errors)) in picture:
                picture.box((picture.x[0], value), (row + offset, row + offset + 0.35), f"--{errors}")
        if dimension.floor in picture:
            picture.line([dimension.floor] * 2, [row - 0.4, row + 0.4], "--floor")
    return picture.svg(f"error before and after, {unit}", below=f"error, {unit}")


def horizon_lines(horizons: Sequence[HorizonError], dimension: DimensionError) -> str:
    """Draws the error of one dimension against the prediction horizon."""
    horizons = [horizon for horizon in horizons if dimension.name in horizon.before]
    seconds = [horizon.seconds for horizon in horizons]
    drawn = {errors: [getattr(horizon, errors).get(dimension.name) for horizon in horizons] for errors in SERIES}
    picture = _Picture(
        (0.0, 1.05 * max(seconds, default=1.0)), _log_range([*drawn["before"], *drawn["after"]]), log=True
    )
    picture.ticks_below(_ticks(picture.x))
    picture.ticks_beside(_log_ticks(picture.y))
    for errors, values in drawn.items():
        picture.line(seconds, [_positive(value) for value in values], f"--{errors}")
        picture.dots(seconds, [_positive(value) for value in values], f"--{errors}", 12)
    title = f"{dimension.name} ({_unit(dimension.unit)})"
    return picture.svg(f"error of {dimension.name} against the horizon", title, "predicted ahead (s)")


def window_lines(window: ShownWindow, quantity: WindowQuantity) -> str:
    """Draws one quantity in a window: measured, and simulated before and after the effects are put in."""
    picture = _Picture((window.ahead[0], window.ahead[-1]), _frame(quantity), height=420)
    picture.ticks_below(_ticks(picture.x))
    picture.ticks_beside(_ticks(picture.y))
    for errors in SERIES:
        picture.line(window.ahead, getattr(quantity, errors), f"--{errors}")
    picture.dots(window.ahead, quantity.measured, "--ink", 9)
    label = f"{quantity.name}, measured and simulated, in the {window.rank} window"
    return picture.svg(label, f"{quantity.name} ({_unit(quantity.unit)})", "time since the start of the window (s)")


def _frame(quantity: WindowQuantity) -> Range:
    """Limits that show the measured values and the simulation with the effects, but not all of one that diverges."""
    measured, simulated = np.array(quantity.measured), np.array([*quantity.before, *quantity.after])
    low, high = measured.min(), measured.max()
    simulated = simulated[np.isfinite(simulated)]
    reach = 10.0 * max(high - low, 1e-9 + 1e-3 * np.abs(measured).max())
    shown = np.concatenate([measured, np.clip(simulated, low - reach, high + reach)])
    margin = 0.06 * (np.ptp(shown) or 1.0)
    return float(shown.min() - margin), float(shown.max() + margin)


def residual_in_time(trace: ResidualTrace, dimension: int, aside: Sequence[Interval] = ()) -> str:
    """Draws the residual of one dimension over time; held-out and excluded intervals are shaded."""
    fitted = _fitted(trace, aside)
    ends = (float(trace.time[0]), float(trace.time[-1])) if len(trace.time) > 1 else (0.0, 1.0)
    picture = _Picture(ends, _size(trace, dimension, fitted))
    changes = np.flatnonzero(np.diff(np.concatenate([[False], trace.held_out, [False]]).astype(int)))
    for first, stop in changes.reshape(-1, 2):
        picture.box((float(trace.time[first]), float(trace.time[stop - 1])), picture.y, "--shade")
    for interval in aside:
        picture.box((interval.start, interval.end), picture.y, "--aside")
    _points(picture, trace.time, trace, dimension)
    return picture.svg(f"residual of {trace.names[dimension]} in time", _title(trace, dimension), "time (s)")


def residual_against_state(trace: ResidualTrace, dimension: int, state: int, aside: Sequence[Interval] = ()) -> str:
    """Draws the residual of one dimension against one state, without excluded intervals."""
    fitted = _fitted(trace, aside)
    states = np.where(fitted, trace.states[:, state], np.nan)
    shown = states[np.isfinite(states)]
    picture = _Picture((shown.min(), shown.max()) if len(shown) else (0.0, 1.0), _size(trace, dimension, fitted))
    _points(picture, states, trace, dimension)
    below = f"{trace.names[state]} ({_unit(trace.units[state])})"
    label = f"residual of {trace.names[dimension]} against {trace.names[state]}"
    return picture.svg(label, _title(trace, dimension), below)


def _points(picture: "_Picture", x: np.ndarray, trace: ResidualTrace, dimension: int) -> None:
    picture.ticks_below(_ticks(picture.x))
    picture.ticks_beside(_ticks(picture.y))
    picture.line(picture.x, [0.0, 0.0], "--muted", 1)
    for errors in SERIES:
        picture.dots(x, getattr(trace, errors)[:, dimension], f"--{errors}", 5)


def _size(trace: ResidualTrace, dimension: int, framed: np.ndarray) -> Range:
    """Limits around zero for the residuals of some rows, without their outliers."""
    sizes = np.abs([trace.before[framed, dimension], trace.after[framed, dimension]])
    sizes = sizes[np.isfinite(sizes)]
    limit = float(1.5 * np.quantile(sizes, 0.99)) if len(sizes) else 0.0
    return (-limit, limit) if limit > 0.0 else (-1.0, 1.0)


def _fitted(trace: ResidualTrace, aside: Sequence[Interval]) -> np.ndarray:
    """Mask, (T,), of the rows outside the excluded intervals."""
    fitted = np.ones(len(trace.time), dtype=bool)
    for interval in aside:
        fitted &= (trace.time < interval.start) | (trace.time > interval.end)
    return fitted


def _title(trace: ResidualTrace, dimension: int) -> str:
    return f"residual of {trace.names[dimension]} ({_unit(trace.units[dimension])})"


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


class _Picture:
    """A frame with a horizontal and a vertical axis, and the marks in it.

    Args:
        x: values at the left and right ends; positive ones for a logarithmic axis.
        y: values at the lower and upper ends.
        log: whether the vertical axis is logarithmic; with ``left``, the horizontal one is.
        height: height of the picture.
        left: space for names beside the frame.
    """

    def __init__(self, x: Range, y: Range, *, log: bool = False, height: int = HEIGHT, left: int | None = None):
        self.x, self.y, self.height = _not_empty(x), _not_empty(y), height
        self.left, self.right, self.top, self.bottom = left or 110, WIDTH - 24, 46 if left is None else 8, height - 76
        self._scales: tuple[Callable, Callable] = (
            np.asarray if left is None else np.log,
            np.log if log else np.asarray,
        )
        self._marks: list[str] = []

    def __contains__(self, value: float | None) -> bool:
        return value is not None and self.x[0] <= value <= self.x[1]

    def across(self, x: Any) -> Any:
        """Horizontal place of values."""
        return self.left + (self.right - self.left) * _share(x, self.x, self._scales[0])

    def down(self, y: Any) -> Any:
        """Vertical place of values."""
        return self.bottom - (self.bottom - self.top) * _share(y, self.y, self._scales[1])

    def line(self, x: Any, y: Any, colour: str, width: int = 4) -> None:
        """A line through points, interrupted where a value is not finite, within the frame."""
        steps, drawn = [], False
        for right, down in zip(self.across(x), np.clip(self.down(y), self.top, self.bottom), strict=True):
            finite = np.isfinite(down) and np.isfinite(right)
            steps += [f"{'L' if drawn else 'M'}{right:.0f} {down:.0f}"] if finite else []
            drawn = bool(finite)
        self._path("".join(steps), colour, f'stroke-width="{width}"')

    def dots(self, x: Any, y: Any, colour: str, size: int) -> None:
        """A dot at each point inside the frame."""
        right, down = self.across(x), self.down(y)
        with np.errstate(invalid="ignore"):
            inside = (right >= self.left) & (right <= self.right) & (down >= self.top) & (down <= self.bottom)
        places = np.unique(np.stack([right[inside], down[inside]], -1).round().astype(int), axis=0)
        steps = "".join(f"M{right} {down}h0" for right, down in places)
        self._path(steps, colour, f'stroke-width="{size}" stroke-linecap="round" opacity="0.6"')

    def _path(self, steps: str, colour: str, style: str) -> None:
        if steps:
            self._marks.append(f'<path d="{steps}" fill="none" stroke="var({colour})" {style}/>')

    def box(self, x: Range, y: Range, colour: str) -> None:
        """A filled rectangle."""
        (left, right), (low, high) = np.sort(self.across(x)), np.sort(self.down(y))
        size = f'x="{left:.0f}" y="{low:.0f}" width="{max(right - left, 1):.0f}" height="{high - low:.0f}"'
        self._marks.append(f'<rect {size} fill="var({colour})"/>')

    def text(self, x: float, y: float, words: str, anchor: str, colour: str = "--muted") -> None:
        """Words at a place of the picture."""
        place = f'x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" fill="var({colour})"'
        self._marks.append(f"<text {place}>{escape(words)}</text>")

    def ticks_below(self, values: Sequence[float]) -> None:
        """Numbers below the frame, with lines through it."""
        for value, x in zip(values, self.across(values), strict=True):
            self.line([value] * 2, self.y, "--shade", 1)
            self.text(x, self.bottom + 26, number(value, 4), "middle")

    def ticks_beside(self, values: Sequence[float]) -> None:
        """Numbers on the left of the frame, with lines through it."""
        for value, y in zip(values, self.down(values), strict=True):
            self.line(self.x, [value] * 2, "--shade", 1)
            self.text(self.left - 10, y + 6, number(value), "end")

    def svg(self, label: str, title: str = "", below: str = "") -> str:
        """The picture as an SVG element for an HTML page, with a label for screen readers."""
        self.text(self.left, 26, title, "start", "--ink")
        self.text((self.left + self.right) / 2, self.height - 14, below, "middle")
        frame = f'viewBox="0 0 {WIDTH} {self.height}" font-size="20" role="img" aria-label="{escape(label)}"'
        return f'<svg xmlns="http://www.w3.org/2000/svg" {frame}>{"".join(self._marks)}</svg>'


def _share(values, ends: Range, scale: Callable) -> np.ndarray:
    """How far values are from the first to the second end of an axis, from 0 to 1."""
    first, last = scale(ends[0]), scale(ends[1])
    return (scale(np.asarray(values, float)) - first) / (last - first)


def _not_empty(ends: Range) -> Range:
    return ends if ends[0] != ends[1] else (ends[0] - 1.0, ends[1] + 1.0)


def _ticks(ends: Range, most: int = 5) -> list[float]:
    """Round numbers between the ends of a linear axis."""
    rough = (ends[1] - ends[0]) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough)
    return [float(i * step) for i in range(int(np.ceil(ends[0] / step)), int(np.floor(ends[1] / step)) + 1)]


def _log_ticks(ends: Range, most: int = 6) -> list[float]:
    """Powers of ten between the ends of a logarithmic axis, with their 2 and 5 fold if there are few."""
    low, high = np.log10(ends)
    factors = (1.0, 2.0, 5.0) if high - low < 2.0 else (1.0,)
    step = max(1, round((high - low) / most))
    powers = range(int(np.floor(low)), int(np.ceil(high)) + 1, step)
    ticks = [factor * 10.0**power for power in powers for factor in factors]
    return [tick for tick in ticks if ends[0] <= tick <= ends[1]]


def _log_range(values: Sequence[float | None]) -> Range:
    finite = [value for value in map(_positive, values) if np.isfinite(value)]
    return (min(finite) / 2.0, max(finite) * 1.5) if finite else (0.1, 1.0)


def _positive(value: float | None) -> float:
    """The value, or NaN, which is not drawn, if it is not positive."""
    return value if value is not None and np.isfinite(value) and value > 0.0 else np.nan


def _unit(unit: str) -> str:
    return "no unit" if unit in ("", "1") else unit
