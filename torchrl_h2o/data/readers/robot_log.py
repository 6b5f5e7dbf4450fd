"""Read a robot's log into TED: parse, convert to SI, link rows into transitions, and estimate missing velocities.

Rows t and t + 1 form a transition, so the last row of a run is used only as a next observation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError, require_finite
from torchrl_h2o.data.readers.log_columns import LogColumns
from torchrl_h2o.data.readers.log_links import link_rows
from torchrl_h2o.data.readers.log_table import LogTable, read_table
from torchrl_h2o.data.readers.observed import observe
from torchrl_h2o.data.readers.resample import resample
from torchrl_h2o.data.readers.ted import to_ted

Reward = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def read_robot_log(
    path: str | PathLike[str],
    columns: LogColumns | str | Path | Mapping[str, Any],
    *,
    reward: Reward | None = None,
) -> TensorDict:
    """Read a log whose columns are described by a layout.

    The numbers of dropped rows and clipped actions are logged. The first row with done = 1 is the terminal next
    observation; later rows with done = 1 are dropped.

    Args:
        path: the log.
        columns: its layout, a YAML file with it, the entries of such a file, or the name of a layout of the package.
        reward: ``reward(observation (T, n), action (T, m), next_observation (T, n)) -> (T,)`` on float64 arrays in
            SI. Without it and without a reward column, the result has no ("next", "reward"), which system
            identification does not need.

    Returns:
        TensorDict of batch size [T] in TED, with a float64 ``time`` in s of shape [T, 1]. If the layout has velocities
        that are estimated from positions, ``observation_std`` of shape [T, n] is the standard deviation of their
        errors, in SI, and 0 for measured columns. Rows at the ends of runs then have no transitions.

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
    if layout.resample is not None:
        table = resample(table, layout)
        layout = replace(layout, dt=layout.resample, resample=None)
    links = link_rows(table, layout)
    observation, stds, links = observe(table, layout, links)
    action = table.columns(layout.action)
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
    if layout.derivatives:
        td["observation_std"] = torch.tensor(stds, dtype=torch.float32).repeat(len(td), 1)
    torchrl_logger.info(
        f"{path}: {len(links.start)} transitions from {len(table.rows)} rows; "
        f"{table.zero_rows} zero rows dropped at the end, {links.dropped} rows dropped because "
        f"they belong to no transition, {clipped} actions clipped"
    )
    return td


def _time(table: LogTable, layout: LogColumns) -> np.ndarray:
    column = layout.named("time")
    if column is None:
        return np.arange(len(table.rows)) * cast("float", layout.dt)  # a layout has dt or a time column
    return table.columns([column.name])[:, 0]


def _bounded(action: np.ndarray, start: np.ndarray, table: LogTable, layout: LogColumns) -> tuple[np.ndarray, int]:
    by_name = {column.name: column for column in layout.columns}
    bounds = [by_name[name].bounds or (-np.inf, np.inf) for name in layout.action]
    low, high = np.array(bounds).reshape(-1, 2).T
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
