"""Which files a source of data stands for: one file, a list, a glob, or a folder of logs."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.formats import FORMATS
from torchrl_h2o.data.readers.formats.lerobot import is_lerobot
from torchrl_h2o.data.readers.formats.split_log import SplitLog

One = str | PathLike[str]
Source = One | Mapping[str, One] | Sequence[One | Mapping[str, One]]

_HDF5_SUFFIXES = {".hdf5", ".h5", ".hdf"}
_HDF5_START = b"\x89HDF\r\n\x1a\n"


def sources_of(source: Source) -> tuple[One, ...]:
    """Return the single sources that a source stands for, each once.

    Args:
        source: a source of :func:`~torchrl_h2o.data.load`: a file, a Minari name or a folder with a data set; a folder
            of logs, which stands for its files of known suffixes in the order of their names; a glob, such as
            ``"logs/*.csv"``; a mapping of names to the files of one run, which are joined on time; or a list of all
            these.

    Raises:
        DataError: for an empty list, a glob without matches, a folder without data, or what is no path.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data import sources_of
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> for name in ("b.csv", "a.csv", "notes.md"):
        ...     _ = (folder / name).write_text("1 2")
        >>> [path.name for path in sources_of(folder)]
        ['a.csv', 'b.csv']
    """
    if isinstance(source, SplitLog):
        return (source,)
    if isinstance(source, Mapping):
        return (_split(source),)
    if not isinstance(source, str | PathLike):
        if not isinstance(source, Sequence):
            problem = f"{source!r} is neither a path nor a list of paths"
            raise DataError(problem, "give a file, a folder, a glob or a Minari name", source="data")
        if not len(source):
            raise DataError("the list of data is empty", "name at least one file", source="data")
        return unique([one for part in source for one in sources_of(part)])
    path = Path(source).expanduser()
    if path.is_dir():
        return _in_folder(path)
    if not path.exists() and re.search(r"[*?\[]", str(source)):
        found = sorted(Path(name) for name in glob.glob(str(path), recursive=True))
        if not found:
            raise DataError("no file has such a name", "check the path", source=source)
        return unique([one for part in found for one in sources_of(part)])
    return (source,)


def unique(sources: Sequence[One]) -> tuple[One, ...]:
    """Return the sources without repetitions: ``a.csv`` and ``./a.csv`` are the same."""
    first: dict[str, One] = {}
    for one in sources:
        first.setdefault(str(one) if isinstance(one, SplitLog) else os.path.abspath(one), one)
    return tuple(first.values())


def is_data_set(folder: Path) -> bool:
    """Whether a folder is a Minari data set or a memory-mapped TensorDict."""
    return any((folder / name).is_file() for name in ("meta.json", "metadata.json", "data/metadata.json"))


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5 by its suffix or first bytes, thus a D4RL file."""
    if path.suffix.lower() in _HDF5_SUFFIXES:
        return True
    with path.open("rb") as file:
        return file.read(len(_HDF5_START)) == _HDF5_START


def is_log(source: Source) -> bool:
    """Whether a source is one or several logs, which need a description of their columns.

    Raises:
        DataError: see :func:`sources_of`.
    """
    return all(is_lerobot(one) or (Path(one).is_file() and not is_hdf5(Path(one))) for one in sources_of(source))


def names_of(sources: Sequence[One]) -> tuple[str, ...]:
    """Return a short name for each source: the name of the file, with its folders where two have the same.

    Example:
        >>> from torchrl_h2o.data.readers.sources import names_of
        >>> names_of(["monday/a.csv", "tuesday/a.csv", "tuesday/b.csv"])
        ('monday/a.csv', 'tuesday/a.csv', 'b.csv')
    """
    short = [Path(one).name if Path(one).exists() or Path(one).suffix else str(one) for one in sources]
    return tuple(str(one) if short.count(name) > 1 else name for one, name in zip(sources, short, strict=True))


def words_of(source: Source) -> str:
    """Return a source in words for reports and errors; several by their names.

    Example:
        >>> from torchrl_h2o.data.readers.sources import words_of
        >>> words_of(["a.csv", "b.csv"])
        'a.csv, b.csv'
    """
    if isinstance(source, Mapping):
        return ", ".join(f"{name}: {path}" for name, path in source.items())
    return str(source) if isinstance(source, str | PathLike) else ", ".join(map(str, source))


def _split(files: Mapping[str, One]) -> SplitLog:
    paths = {str(name): Path(path).expanduser() for name, path in files.items() if isinstance(path, str | PathLike)}
    for path in paths.values():
        require_file(path)
    if len(paths) < max(2, len(files)):
        problem = f"{dict(files)!r} does not name the files of one run"
        raise DataError(problem, "give two or more, such as {position: a.csv, effort: b.csv}", source="data")
    return SplitLog(paths)


def _in_folder(folder: Path) -> tuple[Path, ...]:
    if is_data_set(folder) or is_lerobot(folder):
        return (folder,)
    logs = sorted(path for path in folder.iterdir() if path.suffix.lower() in FORMATS)
    if not logs:
        raise DataError(
            "the folder holds neither a Minari dataset (data/metadata.json) nor a memory-mapped TensorDict (meta.json) "
            f"nor logs ({', '.join(FORMATS)})",
            "give a folder that holds one of them",
            source=folder,
        )
    return tuple(logs)
