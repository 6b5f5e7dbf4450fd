"""Resample a log with irregular time stamps to a regular clock, because a simulator takes equal steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.log_columns import Column, LogColumns
from torchrl_h2o.data.readers.log_links import done_rows, require_increasing, same_episode
from torchrl_h2o.data.readers.log_table import LogTable
from torchrl_h2o.data.readers.units import to_si
from torchrl_h2o.data.readers.velocity import estimate_velocity

TURN = 2.01 * np.pi  # rad, range of an angle that wraps, with some tolerance
_ROUNDING = 1e-6  # share of a step by which the last row may be too early for it
STALE_ROWS = 10  # successive rows with the readings of the row before that may be lost packets; for longer, it rests
MOST_NEW_ROWS = 50  # rows of the new clock for each row of the log: more take memory and hold no information


def resample(table: LogTable, layout: LogColumns) -> LogTable:
    """Resample the rows of a log to the clock of ``layout.resample``.

    Observations are interpolated linearly between two rows. An angle that stays within one turn may jump by 2π between
    them. Each action of the file holds until the next row; a resampled action is the mean of what was held during its
    step. After a lost packet, all sensors show the readings of the row before; such rows are not used for observations.
    If more than :data:`STALE_ROWS` successive rows are equal, the robot rests, and they are used. A run ends with
    the last step before its ``done`` is 1, or at a gap that is longer than ``time_tolerance`` allows.

    Args:
        table: the numbers of the log.
        layout: its columns, with ``resample``.

    Returns:
        The table with the new clock as its time; ``rows`` are those at or before each step.

    Raises:
        DataError: for time that does not increase, a gap where the layout does not split, no two steps, or a step far
            below the log's own.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data import Column, LogColumns, read_robot_log
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> _ = path.write_text("t,q,u\\n0,0,1\\n0.009,0.9,1\\n0.021,2.1,1\\n0.03,3,1\\n")
        >>> columns = Column("t", "time", "s"), Column("q", "observation"), Column("u", "action")
        >>> td = read_robot_log(path, LogColumns(columns, separator=",", header=True, resample=0.01))
        >>> td["next", "observation"].flatten().tolist()
        [1.0, 2.0, 3.0]
    """
    time = table.columns([cast("Column", layout.named("time")).name])[:, 0]  # a layout with resample has one
    done = done_rows(table, layout)
    linked = same_episode(table, layout, done)
    steps = require_increasing(table, layout, linked)
    measured = [name for name in layout.observation if name in table.names]  # estimated velocities are not in the file
    stale = _stale(table.columns(measured))
    step = cast("float", layout.resample)
    runs = _up_to_fresh(_runs(steps, linked, table, layout), stale)
    _require_plausible_step(step, sum(float(time[run.stop - 1] - time[run.start]) for run in runs), table)
    parts = [
        _resampled(table, layout, _Run(time[run], step, stale[run], run, bool(done[run.stop - 1])))
        for run in runs
        if time[run.stop - 1] - time[run.start] >= step * (1.0 - _ROUNDING)
    ]
    if not parts:
        raise DataError(
            f"no run is as long as a step of {step:g} s", "correct resample or time_tolerance", source=table.source
        )
    values, rows = (np.concatenate(each) for each in zip(*parts, strict=True))
    torchrl_logger.info(
        f"{table.source}: resampled to {step:g} s, {len(rows)} rows from {len(time)}; readings of {stale.sum()} rows "
        "repeat the row before in every sensor and were not used"
    )
    return LogTable(table.source, table.names, values, rows, table.zero_rows, _noise(table, layout, runs, steps))


def _require_plausible_step(step: float, duration: float, table: LogTable) -> None:
    least = duration / (MOST_NEW_ROWS * len(table.rows))
    if step < least:
        raise DataError(
            f"resample: {step:g} s gives {duration / step:.3g} rows from {len(table.rows)}",
            f"give at least {1.05 * least:.2g} s, a step near the log's own",
            source=table.source,
        )


def _noise(table: LogTable, layout: LogColumns, runs: list[slice], steps: np.ndarray) -> dict[str, float]:
    """Standard deviation of the noise of positions whose velocities are estimated, as white noise on the new clock.

    It is that of the file's rows, as if they were evenly spaced; between these, interpolation adds rows without
    information.
    """
    usual = float(np.median(np.concatenate([steps[run.start : run.stop - 1] for run in runs])))
    more_rows = max(1.0, usual / cast("float", layout.resample))
    units, found = {column.name: to_si(column.unit)[0] for column in layout.columns}, {}
    for name in set(layout.derivatives.values()):
        try:
            estimate = estimate_velocity(table.columns([name])[:, 0], runs, usual, angle=units[name] == "rad")
        except ValueError:  # the runs are too short, as the velocity's estimate will say
            continue
        found[name] = float(np.sqrt(more_rows)) * estimate.position_std
    return found


@dataclass(frozen=True)
class _Run:
    """An unbroken run and its new clock.

    Args:
        time: stamps of the run's rows in s, increasing.
        step: step of the new clock in s.
        stale: whether the readings of a row are those of the row before.
        rows: the run's rows in the table.
        ends: whether done is 1 in its last row.
    """

    time: np.ndarray
    step: float
    stale: np.ndarray
    rows: slice
    ends: bool

    @property
    def clock(self) -> np.ndarray:
        """The new stamps, the first of which is that of the run's first row."""
        count = int((self.time[-1] - self.time[0]) / self.step + _ROUNDING) + 1
        return self.time[0] + self.step * np.arange(count)

    @property
    def before(self) -> np.ndarray:
        """The last row at or before each new stamp, counted from the run's first."""
        return np.searchsorted(self.time, self.clock + _ROUNDING * self.step, side="right") - 1


def _runs(steps: np.ndarray, linked: np.ndarray, table: LogTable, layout: LogColumns) -> list[slice]:
    """Rows of each run, which ends with its episode or at a gap.

    Raises:
        DataError: for a gap, unless the layout splits there.
    """
    usual = float(np.median(steps[linked])) if linked.any() else 0.0
    longest = (1.0 + layout.time_tolerance) * max(usual, cast("float", layout.resample))
    gaps = linked & (steps > longest)
    if gaps.any() and layout.on_time_jump == "error":
        index = int(np.argmax(gaps))
        raise DataError(
            f"the time step is {steps[index]:.9g} s; time_tolerance allows interpolation over {longest:.4g} s",
            "set on_time_jump: split, or widen time_tolerance",
            source=table.source,
            column=cast("Column", layout.named("time")).name,
            row=int(table.rows[index + 1]),
        )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], linked & ~gaps, [False]]).astype(int)))
    return [slice(int(first), int(last) + 1) for first, last in edges.reshape(-1, 2)]


def _up_to_fresh(runs: list[slice], stale: np.ndarray) -> list[slice]:
    """The runs without stale rows at their ends, whose readings are unknown."""
    return [slice(run.start, int(np.flatnonzero(~stale[run])[-1]) + 1 + run.start) for run in runs]


def _stale(observation: np.ndarray) -> np.ndarray:
    """Rows that repeat the row before in every sensor, in stretches of at most STALE_ROWS; longer ones rest."""
    same = np.concatenate([[False], (observation[1:] == observation[:-1]).all(1), [False]])
    stale = np.zeros(len(observation), bool)
    for first, last in np.flatnonzero(np.diff(same.astype(int))).reshape(-1, 2) + 1:
        stale[first:last] = last - first <= STALE_ROWS
    return stale


def _resampled(table: LogTable, layout: LogColumns, run: _Run) -> tuple[np.ndarray, np.ndarray]:
    """Values (steps, columns) and row numbers (steps,) of a run on its new clock."""
    by_name = {column.name: column for column in layout.in_file}
    columns = [_column(by_name[name], table.columns([name])[run.rows, 0], run) for name in table.names]
    return np.stack(columns, axis=1), table.rows[run.rows][run.before]


def _column(column: Column, values: np.ndarray, run: _Run) -> np.ndarray:
    if column.role == "time":
        return run.clock
    if column.role == "action":
        return _mean_action(values, run)
    if column.role == "run":
        return values[run.before]
    if column.role == "done":
        return np.append(np.zeros(len(run.clock) - 1), float(run.ends))
    return _interpolated(values, run, angle=to_si(column.unit)[0] == "rad" and not column.unwrap)


def _interpolated(values: np.ndarray, run: _Run, *, angle: bool) -> np.ndarray:
    fresh = ~run.stale
    fresh[0] = True  # a run may begin with a repeated reading
    time, known = run.time[fresh], values[fresh]
    wraps = angle and np.ptp(known) <= TURN  # an angle that counts its turns does not jump
    found = np.interp(run.clock, time, np.unwrap(known) if wraps else known)
    if wraps:
        nearest = values[run.before]
        found -= 2.0 * np.pi * np.round((found - nearest) / (2.0 * np.pi))
    return found


def _mean_action(values: np.ndarray, run: _Run) -> np.ndarray:
    """Mean of the held action over each step; that of the last step has no next row and is the last one held."""
    integral = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(run.time))])
    mean = np.diff(np.interp(run.clock, run.time, integral)) / run.step
    return np.append(mean, values[run.before[-1]])
