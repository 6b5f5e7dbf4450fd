"""Read a robot's log, text or CSV, into TED: parse, convert to SI, and link rows into transitions.

Rows t and t + 1 form a transition, so the last row of a run is used only as a next observation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError, require_finite
from torchrl_h2o.data.readers.log_columns import LogColumns
from torchrl_h2o.data.readers.log_table import LogTable, read_table
from torchrl_h2o.data.readers.settings import READER_SETTINGS, ReaderSettings
from torchrl_h2o.data.readers.ted import to_ted

Reward = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def read_robot_log(
    path: str | Path,
    columns: LogColumns | str | Path,
    *,
    reward: Reward | None = None,
    settings: ReaderSettings = READER_SETTINGS,
) -> TensorDict:
    """Read a log whose columns are described by a layout.

    The numbers of dropped rows and clipped actions are logged. The first row with done = 1 is the terminal next
    observation; later rows with done = 1 are dropped.

    Args:
        path: the log.
        columns: its layout, or a YAML file with it, or the name of a layout of the package.
        reward: ``reward(observation (T, n), action (T, m), next_observation (T, n)) -> (T,)`` on float64 arrays in
            SI. Without it and without a reward column, the result has no ("next", "reward"), which system
            identification does not need.
        settings: the tolerance of the clock.

    Returns:
        TensorDict of batch size [T] in TED, with a float64 ``time`` in s of shape [T, 1].

    Raises:
        DataError: with file, column and line number.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data import Column, LogColumns, read_robot_log
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.txt"
        >>> _ = path.write_text("0.0 1.0\\n90.0 2.0\\n180.0 3.0\\n")
        >>> layout = LogColumns(
        ...     (Column("pitch", "observation", "deg"), Column("torque", "action", "N·m")), dt=0.01)
        >>> td = read_robot_log(path, layout)
        >>> td["next", "observation"].flatten().tolist()
        [1.5707963705062866, 3.1415927410125732]
    """
    layout = columns if isinstance(columns, LogColumns) else LogColumns.load(columns)
    table = read_table(path, layout)
    observation, action = table.columns(layout.observation), table.columns(layout.action)
    links = _link_rows(table, layout, settings)
    action, clipped = _bounded(action, links.start, table, layout)
    observed, acted = observation[links.start], action[links.start]
    following = observation[links.start + 1]
    td = to_ted(
        observation=observed,
        action=acted,
        next_observation=following,
        terminated=links.terminated,
        truncated=links.truncated,
        reward=_rewards(table, layout, reward, links.start, observed, acted, following),
    )
    td["time"] = torch.from_numpy(_time(table, layout)[links.start])[:, None]
    torchrl_logger.info(
        f"{path}: {len(links.start)} transitions from {len(table.rows)} rows; "
        f"{table.zero_rows} zero rows dropped at the end, {links.dropped} rows dropped because "
        f"they belong to no transition, {clipped} actions clipped"
    )
    return td


@dataclass(frozen=True)
class _Links:
    """The first rows of all transitions and their flags.

    Args:
        start: index of the first row of each transition, (T,).
        terminated: whether the second row has done = 1, (T,).
        truncated: whether the run ends after the transition although done is 0, (T,).
        dropped: number of rows that belong to no transition.
    """

    start: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    dropped: int


def _link_rows(table: LogTable, layout: LogColumns, settings: ReaderSettings) -> _Links:
    done = _done(table, layout)
    linked = ~done[:-1]
    _require_declared_restart(table, layout, done)
    if layout.after_done == "drop" and done.any():
        linked[np.argmax(done) :] = False
    linked &= ~_jumps(table, layout, linked, settings)
    start = np.flatnonzero(linked)
    if not len(start):
        raise DataError(
            "no two rows make a transition",
            "record more, or correct done, time_tolerance or on_time_jump",
            source=table.source,
        )
    terminated = done[start + 1]
    continues = np.append(linked, False)[start + 1]
    used = np.zeros(len(done), bool)
    used[start] = used[start + 1] = True
    return _Links(start, terminated, ~terminated & ~continues, int((~used).sum()))


def _done(table: LogTable, layout: LogColumns) -> np.ndarray:
    column = layout.named("done")
    if column is None:
        return np.zeros(len(table.rows), bool)
    values = table.columns([column.name])[:, 0]
    wrong = np.flatnonzero((values != 0) & (values != 1))
    if len(wrong):
        raise DataError(
            f"done is {values[wrong[0]]:g}",
            "it must be 0 or 1",
            source=table.source,
            column=column.name,
            row=int(table.rows[wrong[0]]),
        )
    return values.astype(bool)


def _require_declared_restart(table: LogTable, layout: LogColumns, done: np.ndarray) -> None:
    column, restarts = layout.named("done"), np.flatnonzero(done[:-1] & ~done[1:])
    if column is not None and len(restarts) and layout.after_done == "error":
        raise DataError(
            "done falls back to 0 after the run has ended",
            "state how to treat these rows: after_done: drop, or after_done: new_episode",
            source=table.source,
            column=column.name,
            row=int(table.rows[restarts[0] + 1]),
        )


def _jumps(table: LogTable, layout: LogColumns, linked: np.ndarray, settings: ReaderSettings) -> np.ndarray:
    """Return a mask of the linked pairs of rows whose time step is not dt; raise DataError unless these are split."""
    column = layout.named("time")
    if column is None:
        return np.zeros(len(linked), bool)
    time = table.columns([column.name])[:, 0]
    steps = np.diff(time)
    place: dict[str, Any] = {"source": table.source, "column": column.name}
    backwards = np.flatnonzero(linked & (steps <= 0))
    if len(backwards):
        index = backwards[0]
        raise DataError(
            f"time goes from {time[index]:.9g} s to {time[index + 1]:.9g} s",
            "time must increase: split the file into its runs, or set drop_trailing_zero_rows if the logger pads the "
            "end of the file with zeros",
            row=int(table.rows[index + 1]),
            **place,
        )
    dt = _dt(steps[linked], layout, place, settings)
    jumps = linked & (np.abs(steps - dt) > layout.time_tolerance * dt)
    if jumps.any() and layout.on_time_jump == "error":
        index = np.argmax(jumps)
        raise DataError(
            f"the time step is {steps[index]:.9g} s, dt is {dt:.9g} s",
            "correct dt, widen time_tolerance, or set on_time_jump: split",
            row=int(table.rows[index + 1]),
            **place,
        )
    return jumps


def _dt(steps: np.ndarray, layout: LogColumns, place: dict[str, Any], settings: ReaderSettings) -> float:
    """Return the layout's dt after comparing it with the steps between linked rows; without it, their median."""
    if layout.dt is None or not len(steps):
        return float(np.median(steps)) if len(steps) else 0.0
    median = float(np.median(steps))
    # at 300 Hz a clock with a resolution of 1 ms gives steps of 3, 3, 4 ms; then the mean without gaps is accurate
    mean = float(np.mean(steps[steps <= settings.longest_regular_step * median]))
    # time_tolerance is for single late rows and would accept a dt that is wrong throughout
    if min(abs(median - layout.dt), abs(mean - layout.dt)) > settings.clock_tolerance * layout.dt:
        raise DataError(
            f"the median time step is {median:.9g} s, dt is {layout.dt:.9g} s",
            "correct dt or the unit of time, or omit dt to use the median",
            **place,
        )
    return layout.dt


def _time(table: LogTable, layout: LogColumns) -> np.ndarray:
    column = layout.named("time")
    if column is None:
        return np.arange(len(table.rows)) * cast("float", layout.dt)  # a layout has dt or a time column
    return table.columns([column.name])[:, 0]


def _bounded(action: np.ndarray, start: np.ndarray, table: LogTable, layout: LogColumns) -> tuple[np.ndarray, int]:
    by_name = {column.name: column for column in layout.columns}
    bounds = [by_name[name].bounds or (-np.inf, np.inf) for name in layout.action]
    low, high = np.array(bounds).T
    # only actions of transitions are checked
    outside = (action[start] < low) | (action[start] > high)
    if outside.any() and layout.outside_bounds == "error":
        index, position = np.argwhere(outside)[0]
        raise DataError(
            f"the action {action[start[index], position]:g} lies outside [{low[position]:g}, {high[position]:g}]",
            "correct unit, scale or bounds, or set outside_bounds: clip",
            source=table.source,
            column=layout.action[position],
            row=int(table.rows[start[index]]),
        )
    return np.clip(action, low, high), int(outside.sum())


def _rewards(
    table: LogTable,
    layout: LogColumns,
    reward: Reward | None,
    start: np.ndarray,
    *transition: np.ndarray,
) -> np.ndarray | None:
    column = layout.named("reward")
    if column is not None:
        if reward is not None:
            raise DataError(
                "the log has a reward column and a reward function was given",
                "use one of them: set the column's role to ignore, or omit the function",
                source=table.source,
                column=column.name,
            )
        return table.columns([column.name])[start, 0]
    if reward is None:
        return None
    values = np.asarray(reward(*transition), dtype=np.float64)
    if values.size != len(start):
        raise DataError(
            f"the reward function returned the shape {list(values.shape)}",
            f"it must return [{len(start)}], one number per transition",
            source=table.source,
        )
    values = values.reshape(-1, 1)
    require_finite(values, ["reward"], source=table.source, row_of=lambda index: int(table.rows[start[index]]))
    return values
