"""Load measured data from any supported source; selects the reader."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict

from torchrl_h2o.data.readers.d4rl import read_d4rl
from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.formats.lerobot import is_lerobot
from torchrl_h2o.data.readers.formats.split_log import SplitLog
from torchrl_h2o.data.readers.guess.contents import require_several_runs
from torchrl_h2o.data.readers.log_columns import LogColumns
from torchrl_h2o.data.readers.memory_map import read_ted
from torchrl_h2o.data.readers.minari_dataset import read_minari
from torchrl_h2o.data.readers.robot_log import Reward, read_robot_log
from torchrl_h2o.data.readers.sources import One, Source, is_hdf5, sources_of, words_of
from torchrl_h2o.data.readers.specs import check_specs, warn_of_unknown_task
from torchrl_h2o.data.readers.ted import entry_name

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

Columns = LogColumns | str | Path | Mapping[str, Any]


def load(
    source: Source,
    *,
    env: EnvBase | None = None,
    columns: Columns | None = None,
    reward: Reward | None = None,
    task: str | None = None,
) -> TensorDict:
    """Load transitions from Minari datasets, D4RL files, robot logs or TED memory maps.

    Each of several sources is a run of its own: its last transition is done.

    Args:
        source: a Minari name (``"halfcheetah/medium-v0"``) or folder, an HDF5 file, a log (.csv, .txt, .parquet, .npz,
            .mat, .pt, .mcap), the folder of a LeRobot dataset, or one written by :func:`write_ted`; or several of them:
            a list, a glob (``"logs/*.csv"``), or a folder of logs; see :func:`sources_of` for their order. A mapping is
            one run in several files of columns, ``{"position": "a.csv", "effort": "b.csv"}``, whose columns are then
            called ``position.hip`` and ``effort.hip``.
        env: an environment; the data's dimensions, kinds of numbers and action bounds are checked against it.
        columns: for a log, the layout of its columns; see :func:`read_robot_log`.
        reward: for a log, its reward function; see :func:`read_robot_log`.
        task: a Gymnasium id such as ``"HalfCheetah-v5"``. A Minari dataset of another task is rejected; the version
            may differ. If the source does not name its task, a warning is logged.

    Returns:
        TensorDict of batch size [T] in TED. From several sources, it has the int64 entry ``log`` of shape [T]: the
        index of the source.

    Raises:
        DataError: with file, column and row, for invalid data; also if columns are given for a source that is not a
            log.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data import load
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.txt"
        >>> _ = path.write_text("0.1 0.2 0.3 0.4 1 0\\n0.1 0.2 0.3 0.4 1 0\\n")
        >>> load(path, columns="wheel_legged_moving_forward")["observation"].shape
        torch.Size([1, 3])
    """
    parts = sources_of(source)
    try:
        tds = [_read(one, columns, reward, task) for one in parts]
    except DataError:
        if columns is not None:
            require_several_runs(parts)
        raise
    td = tds[0] if len(tds) == 1 else _joined(tds, parts)
    if env is not None:
        check_specs(td, env, source=words_of(source))
    return td


def _read(source: One, columns: Columns | None, reward: Reward | None, task: str | None) -> TensorDict:
    path = Path(source).expanduser()
    if isinstance(source, SplitLog) or is_lerobot(path):
        return _read_log(source, columns, reward)
    if path.is_dir():
        _require_no_columns(columns, source)
        return _read_folder(path, task)
    if path.exists() or looks_like_a_path(source):
        return _read_file(path, columns, reward, task)
    _require_no_columns(columns, source)
    return read_minari(str(source), task=task)


def _joined(tds: Sequence[TensorDict], sources: Sequence[One]) -> TensorDict:
    """Join the transitions of several sources, whose last transitions are done, with the entry ``log``."""
    keys, first = set(tds[0].keys(True, True)), tds[0]
    for index, (td, source) in enumerate(zip(tds, sources, strict=True)):
        for key in sorted(keys ^ set(td.keys(True, True)), key=str):
            problem = f"{sources[0] if key in keys else source} has this entry, and another of the data has not"
            raise DataError(problem, "give data of the same kind", source=source, column=entry_name(key))
        for key in ("observation", "action"):
            if td[key].shape[1:] != first[key].shape[1:]:
                raise DataError(
                    f"it has {list(td[key].shape[1:])} entries, {sources[0]} has {list(first[key].shape[1:])}",
                    "give data of the same system",
                    source=source,
                    column=key,
                )
        td["log"] = torch.full((len(td),), index, dtype=torch.int64)
    return cast("TensorDict", torch.cat(list(tds)))


def _require_no_columns(columns: Columns | None, source: One) -> None:
    if columns is not None:
        raise DataError(
            "columns were given, but the source is not a log: its entries have names",
            "omit columns, or give the log",
            source=source,
        )


def _read_folder(path: Path, task: str | None) -> TensorDict:
    if (path / "meta.json").is_file():
        warn_of_unknown_task(task, path)
        return read_ted(path)
    return read_minari(path, task=task)


def _read_file(
    path: Path,
    columns: Columns | None,
    reward: Reward | None,
    task: str | None,
) -> TensorDict:
    path = require_file(path)
    if is_hdf5(path):
        _require_no_columns(columns, path)
        warn_of_unknown_task(task, path)
        return read_d4rl(path)
    return _read_log(path, columns, reward)


def _read_log(path: One, columns: Columns | None, reward: Reward | None) -> TensorDict:
    if columns is None:
        raise DataError(
            "a log does not describe its columns",
            "give columns=, a YAML file as in torchrl_h2o/data/readers/logs; close-the-loop --guess writes a first one",
            source=path,
        )
    return read_robot_log(path, columns, reward=reward)


def looks_like_a_path(source: One) -> bool:
    """Whether a source is a path; a Minari name has no file suffix, does not start with / and ends in a version."""
    return not isinstance(source, str) or not re.fullmatch(r"[-\w]+(/[-\w]+)*-v\d+", source)
