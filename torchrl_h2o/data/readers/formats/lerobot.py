"""Read the tables of a LeRobot dataset of version 2 or 3, a folder with ``meta/info.json`` and ``data/*/*.parquet``.

The format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.formats.parquet import read_parquet
from torchrl_h2o.data.readers.formats.raw_table import RawTable, table_of

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

INFO = "meta/info.json"
_TURN = 4096  # counts a turn of Feetech STS and Dynamixel X servos
_NO_NUMBERS = ("video", "image", "string")


def is_lerobot(path: str | PathLike[str]) -> bool:
    """Whether a path is the folder of a LeRobot dataset."""
    return (Path(path).expanduser() / INFO).is_file()


def read_lerobot(folder: Path, layout: LogColumns | None) -> RawTable:
    """Read the numbers of all episodes, in the order of the tables.

    The columns are named as in ``info.json``: ``action.elbow.pos``, ``observation.state.elbow.pos``, ``timestamp``,
    ``episode_index``. Images are not read.

    Raises:
        DataError: for a damaged description or table, or a dataset whose tables are not there.
    """
    tables = sorted(folder.glob("data/*/*.parquet"))
    if not tables:
        problem = f"the tables of the LeRobot dataset, {folder.name}/data/*/*.parquet, are not there"
        raise DataError(problem, "download the data folder, too; videos are not needed", source=folder)
    parts = [read_parquet(path, None) for path in tables]
    columns: dict[str, Callable[[], np.ndarray]] = {}
    for named in _features(folder).values():
        for column, name in named:
            columns[name] = partial(_column, parts, column)
    return table_of(columns, sum(len(part.rows) for part in parts), folder, layout)


def read_calibration(folder: Path) -> dict[str, float]:
    """Read the range of each servo, in turns, from LeRobot's calibration of the robot in the folder or in ``meta``.

    LeRobot keeps it apart from its datasets, in ``calibration/robots/NAME/ID.json`` of its cache. A range that is
    counted the other way round, ``drive_mode`` 1, is negative.
    """
    found: dict[str, float] = {}
    for path in (*sorted(folder.glob("*.json")), *sorted(folder.glob("meta/*.json"))):
        with unreadable("the file cannot be read as a calibration", source=path):
            content = json.loads(path.read_text(encoding="utf-8"))
            own = {
                motor: (-1 if one.get("drive_mode") else 1) * (one["range_max"] - one["range_min"]) / _TURN
                for motor, one in (content.items() if isinstance(content, dict) else ())
                if isinstance(one, dict) and {"range_min", "range_max"} <= one.keys()
            }
        # two arms have a file each, with the same motors: left.json is of the columns with left_elbow
        found |= {motor if motor not in found else f"{path.stem}_{motor}": range_ for motor, range_ in own.items()}
    return found


def _features(folder: Path) -> dict[str, list[tuple[str, str]]]:
    """The columns of each feature in the tables, each with its name."""
    with unreadable("the description of the LeRobot dataset cannot be read", source=folder / INFO):
        features = json.loads((folder / INFO).read_text(encoding="utf-8"))["features"]
        numbers = {name: one for name, one in features.items() if one["dtype"] not in _NO_NUMBERS}
        return {name: _named(name, one) for name, one in numbers.items()}


def _named(feature: str, described: dict[str, Any]) -> list[tuple[str, str]]:
    """The columns of a feature: ``action[0]`` is ``action.elbow.pos``."""
    names, count = described.get("names"), int(np.prod(described["shape"]))
    if isinstance(names, dict):  # version 2: {"motors": [...]}
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or len(set(map(str, names))) != count:
        names = [f"[{index}]" for index in range(count)]
    dotted = [name if name.startswith("[") else f".{name}" for name in map(str, names)]
    return (
        [(feature, feature)] if count == 1 else [(f"{feature}[{i}]", feature + name) for i, name in enumerate(dotted)]
    )


def _column(parts: list[RawTable], column: str) -> np.ndarray:
    values = []
    for part in parts:
        if column not in (part.names or ()):
            raise DataError("the table lacks this column", "download it again", source=part.source, column=column)
        values.append(part.numbers([(part.names or ()).index(column)], [column])[:, 0])
    return np.concatenate(values)
