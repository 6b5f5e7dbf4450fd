"""Load measured data from any supported source; selects the reader."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from tensordict import TensorDict

from torchrl_h2o.data.readers.d4rl import read_d4rl
from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.log_columns import LogColumns
from torchrl_h2o.data.readers.memory_map import read_ted
from torchrl_h2o.data.readers.minari_dataset import read_minari
from torchrl_h2o.data.readers.robot_log import Reward, read_robot_log
from torchrl_h2o.data.readers.specs import check_specs, warn_of_unknown_task

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

_HDF5_SUFFIXES = {".hdf5", ".h5", ".hdf"}
_HDF5_START = b"\x89HDF\r\n\x1a\n"


def load(
    source: str | Path,
    *,
    env: EnvBase | None = None,
    columns: LogColumns | str | Path | None = None,
    reward: Reward | None = None,
    task: str | None = None,
) -> TensorDict:
    """Load transitions from a Minari dataset, a D4RL file, a robot log or a TED memory map.

    Args:
        source: a Minari name (``"halfcheetah/medium-v0"``) or folder, an HDF5 file, a text or CSV log, or a folder
            written by :func:`write_ted`.
        env: an environment; the data's dimensions, kinds of numbers and action bounds are checked against it.
        columns: for a log, the layout of its columns; see :func:`read_robot_log`.
        reward: for a log, its reward function; see :func:`read_robot_log`.
        task: a Gymnasium id such as ``"HalfCheetah-v5"``. A Minari dataset of another task is rejected; the version
            may differ. If the source does not name its task, a warning is logged.

    Returns:
        TensorDict of batch size [T] in TED.

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
    path = Path(source).expanduser()
    if path.is_dir():
        _require_no_columns(columns, source)
        td = _read_folder(path, task)
    elif path.exists() or _looks_like_a_path(source):
        td = _read_file(path, columns, reward, task)
    else:
        _require_no_columns(columns, source)
        td = read_minari(str(source), task=task)
    if env is not None:
        check_specs(td, env, source=source)
    return td


def _require_no_columns(columns: LogColumns | str | Path | None, source: str | Path) -> None:
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
    if (path / "metadata.json").is_file() or (path / "data" / "metadata.json").is_file():
        return read_minari(path, task=task)
    raise DataError(
        "the folder holds neither a Minari dataset (data/metadata.json) nor a memory-mapped TensorDict (meta.json)",
        "give a folder that holds one of them",
        source=path,
    )


def _read_file(
    path: Path,
    columns: LogColumns | str | Path | None,
    reward: Reward | None,
    task: str | None,
) -> TensorDict:
    path = require_file(path)
    with path.open("rb") as file:
        is_hdf5 = file.read(len(_HDF5_START)) == _HDF5_START
    if is_hdf5 or path.suffix.lower() in _HDF5_SUFFIXES:
        _require_no_columns(columns, path)
        warn_of_unknown_task(task, path)
        return read_d4rl(path)
    if columns is None:
        raise DataError(
            "a log does not describe its columns",
            "give columns=, a YAML file as in torchrl_h2o/data/readers/logs",
            source=path,
        )
    return read_robot_log(path, columns, reward=reward)


def _looks_like_a_path(source: str | Path) -> bool:
    """Whether a source is a path; a Minari name has no file suffix, does not start with / and ends in a version."""
    return isinstance(source, Path) or not re.fullmatch(r"[-\w]+(/[-\w]+)*-v\d+", source)
