"""Link the rows of a log into transitions: where a run ends, restarts, or has a gap in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from torchrl_h2o.data.readers.error import DataError, require_flags
from torchrl_h2o.data.readers.log_columns import Column, LogColumns
from torchrl_h2o.data.readers.log_table import LogTable

CLOCK_TOLERANCE = 0.02  # share of dt by which the usual step of a log may differ: clocks drift less, lost rows do more
LONGEST_REGULAR_STEP = 2.0  # median steps; longer ones are gaps, which the mean step does not count
RESTART = 10.0  # median steps by which time falls back where another run begins; by less, rows are out of order


@dataclass(frozen=True)
class Links:
    """The first rows of all transitions and their flags.

    Args:
        start: index of the first row of each transition, (T,); the second row is the next one of the log.
        terminated: whether the second row has done = 1, (T,).
        truncated: whether the run ends after the transition although done is 0, (T,).
        dropped: number of rows that belong to no transition.
        dt: time between two rows in s.
    """

    start: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    dropped: int
    dt: float

    @classmethod
    def of(cls, linked: np.ndarray, done: np.ndarray, dt: float) -> Links:
        """Build the links of the pairs of rows (t, t + 1) for which ``linked``, (rows - 1,), is true."""
        start = np.flatnonzero(linked)
        terminated = done[start + 1]
        continues = np.append(linked, False)[start + 1]
        used = np.zeros(len(done), bool)
        used[start] = used[start + 1] = True
        return cls(start, terminated, ~terminated & ~continues, int((~used).sum()), dt)

    @property
    def runs(self) -> list[slice]:
        """The rows of each unbroken run."""
        if not len(self.start):
            return []
        ends = np.flatnonzero(np.diff(self.start) > 1)
        firsts, lasts = self.start[np.append(0, ends + 1)], self.start[np.append(ends, -1)]
        return [slice(int(first), int(last) + 2) for first, last in zip(firsts, lasts, strict=True)]

    def between(self, rows: np.ndarray) -> Links:
        """The links whose two rows are both in a mask, (rows,); a run that is cut off by it is truncated."""
        linked, done = np.zeros(len(rows) - 1, bool), np.zeros(len(rows), bool)
        linked[self.start] = rows[self.start] & rows[self.start + 1]
        done[self.start + 1] = self.terminated
        return Links.of(linked, done, self.dt)


def link_rows(table: LogTable, layout: LogColumns) -> Links:
    """Link the rows of a log into transitions.

    Args:
        table: the numbers of the log.
        layout: the columns of time and done, dt, and what to do at a jump in time and after done.

    Raises:
        DataError: for time that does not increase, a time step or a restart that the layout does not allow, a done
            other than 0 and 1, or a log without any transition.
    """
    done = done_rows(table, layout)
    linked = same_episode(table, layout, done)
    jumps, dt = _jumps(table, layout, linked)
    linked &= ~jumps
    if not linked.any():
        raise DataError(
            "no two rows make a transition",
            "record more, or correct done, time_tolerance or on_time_jump",
            source=table.source,
        )
    return Links.of(linked, done, dt)


def done_rows(table: LogTable, layout: LogColumns) -> np.ndarray:
    """Return whether done is 1, for each row, (rows,); false without a column of done.

    Raises:
        DataError: for a done other than 0 and 1.
    """
    column = layout.named("done")
    if column is None:
        return np.zeros(len(table.rows), bool)
    values = table.columns([column.name])[:, 0]
    return require_flags(values, column.name, source=table.source, row_of=lambda index: int(table.rows[index]))


def same_episode(table: LogTable, layout: LogColumns, done: np.ndarray) -> np.ndarray:
    """Return whether a row and the next one are of the same episode, (rows - 1,); false for rows that are dropped.

    Raises:
        DataError: for a restart that the layout does not allow.
    """
    others = _other_runs(table, layout)
    _require_declared_restart(table, layout, done[:-1] & ~done[1:] & ~others)
    linked = ~done[:-1] & ~others
    if layout.after_done == "drop" and done.any():
        linked[np.argmax(done) :] = False
    return linked


def _other_runs(table: LogTable, layout: LogColumns) -> np.ndarray:
    """Whether a row and the next one are of different runs: by their number or, where a layout splits, their time."""
    others = np.zeros(len(table.rows) - 1, bool)
    if (run := layout.named("run")) is not None:
        others |= np.diff(table.columns([run.name])[:, 0]) != 0
    if (column := layout.named("time")) is not None and layout.on_time_jump == "split":
        time = table.columns([column.name])[:, 0]
        steps = np.diff(time)
        usual = float(np.median(steps))
        others |= (steps < -RESTART * usual) | ((steps < 0) & (time[1:] <= time[0] + usual))
    return others


def _require_declared_restart(table: LogTable, layout: LogColumns, restarts: np.ndarray) -> None:
    column = layout.named("done")
    if column is not None and restarts.any() and layout.after_done == "error":
        raise DataError(
            "done falls back to 0 after the run has ended",
            "state how to treat these rows: after_done: drop, or after_done: new_episode",
            source=table.source,
            column=column.name,
            row=int(table.rows[np.argmax(restarts) + 1]),
        )


def _jumps(table: LogTable, layout: LogColumns, linked: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a mask of the linked pairs of rows whose time step is not dt, and dt.

    Raises:
        DataError: at such a pair, unless the layout splits there.
    """
    column = layout.named("time")
    if column is None:
        return np.zeros(len(linked), bool), cast("float", layout.dt)  # a layout has dt or a time column
    steps = require_increasing(table, layout, linked)
    place: dict[str, Any] = {"source": table.source, "column": column.name}
    dt = _dt(steps[linked], layout, place)
    jumps = linked & (np.abs(steps - dt) > layout.time_tolerance * dt)
    if jumps.any() and layout.on_time_jump == "error":
        index = np.argmax(jumps)
        raise DataError(
            f"the time step is {steps[index]:.9g} s, dt is {dt:.9g} s",
            "correct dt, widen time_tolerance, or set on_time_jump: split",
            row=int(table.rows[index + 1]),
            **place,
        )
    return jumps, dt


def require_increasing(table: LogTable, layout: LogColumns, linked: np.ndarray) -> np.ndarray:
    """Return the time steps between rows in s, (rows - 1,), of a layout with a column of time.

    Args:
        table: the numbers of the log.
        layout: the column of time.
        linked: whether a row and the next one belong to the same run, (rows - 1,).

    Raises:
        DataError: for time that does not increase between linked rows.
    """
    name = cast("Column", layout.named("time")).name
    time = table.columns([name])[:, 0]
    steps = np.diff(time)
    backwards = np.flatnonzero(linked & (steps <= 0))
    if len(backwards):
        index = backwards[0]
        raise DataError(
            f"time goes from {time[index]:.9g} s to {time[index + 1]:.9g} s",
            "time must increase: set on_time_jump: split or give a column with role: run if a run begins here, or "
            "set drop_trailing_zero_rows if the logger pads the end with zeros",
            source=table.source,
            column=name,
            row=int(table.rows[index + 1]),
        )
    return steps


def _dt(steps: np.ndarray, layout: LogColumns, place: dict[str, Any]) -> float:
    """Return the layout's dt after comparing it with the steps between linked rows; without it, their median."""
    if layout.dt is None or not len(steps):
        return float(np.median(steps)) if len(steps) else 0.0
    median = float(np.median(steps))
    # at 300 Hz a clock with a resolution of 1 ms gives steps of 3, 3, 4 ms; then the mean without gaps is accurate
    mean = float(np.mean(steps[steps <= LONGEST_REGULAR_STEP * median]))
    # time_tolerance is for single late rows and would accept a dt that is wrong throughout
    if min(abs(median - layout.dt), abs(mean - layout.dt)) > CLOCK_TOLERANCE * layout.dt:
        raise DataError(
            f"the median time step is {median:.9g} s, dt is {layout.dt:.9g} s",
            "correct dt or the unit of time, or omit dt to use the median",
            **place,
        )
    return layout.dt
