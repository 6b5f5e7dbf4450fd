"""What a log shows of itself: separator, header, decimal sign, names and values of its columns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.formats import FORMATS, read_raw
from torchrl_h2o.data.readers.formats.lerobot import is_lerobot, read_calibration
from torchrl_h2o.data.readers.formats.raw_table import RawTable
from torchrl_h2o.data.readers.formats.split_log import SplitLog
from torchrl_h2o.data.readers.formats.text import number_of, read_text, split_rows, with_lists
from torchrl_h2o.data.readers.guess.roles import guess_columns
from torchrl_h2o.data.readers.sources import is_hdf5

_LINES = 50_000  # lines of a text file that are looked at, to find gaps and jumps behind its beginning
_INSIDE = re.compile(r"\"[^\"]*\"|\[[^\]]*\]")  # quoted cells and lists, which may hold the separator


@dataclass(frozen=True)
class Contents:
    """The columns of a log.

    Args:
        values: the numbers of each column by name; None for a column that is not numbers.
        options: entries of the layout that describe the file, such as ``separator``.
        named: whether the names are in the file.
        calibration: for a LeRobot dataset, the range of each servo in turns, as far as it has its calibration.
    """

    values: dict[str, np.ndarray | None]
    options: dict[str, str] = field(default_factory=dict)
    named: bool = True
    calibration: Mapping[str, float] | None = None


def read_contents(path: str | PathLike[str]) -> Contents:
    """Read the names and values of a log's columns.

    Args:
        path: the log, in any format.

    Raises:
        DataError: for a file that cannot be read, or text without rows of numbers.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data.readers.guess.contents import read_contents
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> _ = path.write_text("t;q\\n0,0;1,5\\n0,1;1,6\\n")
        >>> read_contents(path).options
        {'separator': '";"', 'header': 'true', 'decimal': '","'}
    """
    if isinstance(path, SplitLog):
        return _joined(path, {name: read_contents(part) for name, part in path.files.items()})
    contents = _contents(Path(path).expanduser())
    return replace(contents, values=_rows_of_readings(contents.values))


def _contents(path: Path) -> Contents:
    if is_lerobot(path) or FORMATS.get(require_file(path).suffix.lower(), read_text) is not read_text:
        raw = read_raw(path)
        values = {name: _numbers(raw, index, name) for index, name in enumerate(raw.names or ())}
        topic = {"topic": f'"{raw.topic}"'} if raw.topic else {}
        calibration = read_calibration(path) if is_lerobot(path) else None
        return Contents(values, {"header": "true", **topic}, calibration=calibration)
    if is_hdf5(path):
        raise DataError("an HDF5 data set names its arrays", "use it without a description of columns", source=path)
    with unreadable("the file is not text", "give a log", source=path), path.open(encoding="utf-8-sig") as file:
        lines = [line for line, _ in zip(file, range(_LINES), strict=False)]
    return _text(lines, path)


def require_several_runs(paths: Sequence[str | PathLike[str]]) -> None:
    """Raise DataError if files hold different columns of one run: other names, and the same times.

    Args:
        paths: sources of data, of which only logs are compared.
    """
    logs = [Path(path) for path in paths if Path(path).is_file() and not is_hdf5(Path(path))]
    if len(logs) < 2 or len(logs) < len(paths):
        return
    try:
        parts = {path.stem: read_contents(path) for path in logs}
        names = [set(part.values) for part in parts.values()]
        if len(parts) < len(logs) or names[0] in names[1:]:
            return
        _joined(SplitLog(dict(zip(parts, logs, strict=True))), parts)
    except DataError:  # they have no common time, or the readers say what is wrong with a file
        return
    raise DataError(
        f"{', '.join(path.name for path in logs)} have the same times and other columns: they are one run in "
        f"{len(logs)} files",
        f"give 'data={{{', '.join(f'{path.stem}: {path}' for path in logs)}}}', which joins them on time",
        source=logs[0].parent,
    )


def _joined(log: SplitLog, parts: Mapping[str, Contents]) -> Contents:
    """The contents of the files of one run, joined on time."""
    clocks: dict[str, str] = {}
    for name, part in parts.items():
        found = [guess.name for guess in guess_columns(part.values) if guess.kind == "time"]
        if not found or part.options != next(iter(parts.values())).options:
            problem = "no column of time was found" if not found else "it is written in another way than the first file"
            raise DataError(problem, "files of one run are joined on time; join them", source=log.files[name])
        clocks[name] = found[0]
    if len(set(clocks.values())) > 1:
        problem = f"the columns of time are called {', '.join(clocks.values())}"
        raise DataError(problem, "give them the same name in all files", source=str(log))
    rows = log.rows({name: np.asarray(part.values[clocks[name]]) for name, part in parts.items()})
    values = {
        f"{name}.{column}": None if numbers is None else numbers[rows[name]]
        for name, part in parts.items()
        for column, numbers in part.values.items()
    }
    return Contents(values, next(iter(parts.values())).options)


def _rows_of_readings(values: Mapping[str, np.ndarray | None]) -> dict[str, np.ndarray | None]:
    """The rows that have readings; an empty cell has the last number, or the first one before that."""
    empty = {name: np.isnan(numbers) for name, numbers in values.items() if numbers is not None}
    if not any(one.any() for one in empty.values()):
        return dict(values)
    readings = [empty[guess.name] for guess in guess_columns(values) if guess.kind in ("position", "velocity")]
    rows = ~np.all(readings, axis=0) if readings else np.ones(len(next(iter(empty.values()))), bool)
    found: dict[str, np.ndarray | None] = dict(values)
    for name, missing in empty.items():
        known = np.flatnonzero(~missing)
        last = np.searchsorted(known, np.arange(len(missing)), side="right") - 1
        found[name] = np.asarray(values[name])[known[np.maximum(last, 0)]][rows] if len(known) else None
    return found


def _numbers(raw: RawTable, index: int, name: str) -> np.ndarray | None:
    try:
        return raw.numbers([index], [name])[:, 0]
    except DataError:
        return None


def _text(lines: list[str], path: Path) -> Contents:
    first = next((line for line in lines if line.strip()), "")
    mark = next((mark for mark in "#%" if first.startswith(mark)), None)
    separator = _separator([line for line in lines if line.strip() and not (mark and line.lstrip().startswith(mark))])
    rows = split_rows(lines, separator, mark, path)
    decimal = "," if separator != "," and any("," in cell for _, row in rows[1:3] for cell in row) else "."
    header = bool(rows) and not any(_is_number(cell, decimal) for cell in rows[0][1])
    names, body = ([cell.strip("\"'") for cell in rows[0][1]], rows[1:]) if header else (None, rows)
    body = [row for row in body if len(row[1]) == len(body[0][1])]
    names, body = with_lists(names, body)
    if len(body) < 2:
        raise DataError("no two rows of numbers were found", "give a log, one row per time step", source=path)
    width = len(body[0][1])
    options = {"separator": "whitespace" if separator == "whitespace" else f'"{separator}"'.replace("\t", "\\t")}
    options |= {"header": str(header).lower()} | ({"decimal": '","'} if decimal == "," else {})
    if mark:
        options["comment"] = f'"{mark}"'
        ((_, said),) = split_rows([first.lstrip(mark).strip() or "-"], separator, None, path)
        if names is None and len(set(said)) == len(said) == width:  # as numpy.savetxt writes names
            names = said
    columns = zip(*(cells for _, cells in body), strict=True)
    called = names or [f"column_{i}" for i in range(width)]
    values = {name: _column(column, decimal) for name, column in zip(called, columns, strict=False)}
    if not any(column is not None for column in values.values()):
        raise DataError("no column of numbers was found", "give a log, one row per time step", source=path)
    return Contents(values, options, names is not None)


def _separator(rows: list[str]) -> str:
    """The sign that splits all of the first rows into the same number of cells, of at least two, or "whitespace"."""
    for sign in ("\t", ";", ","):
        counts = {_INSIDE.sub("", row).count(sign) for row in rows[:50]}
        if len(counts) == 1 and counts != {0}:
            return sign
    return "whitespace"


def _is_number(cell: str, decimal: str) -> bool:
    try:
        number_of(cell, decimal)
    except ValueError:
        return False
    return True


def _column(cells: tuple[str, ...], decimal: str) -> np.ndarray | None:
    try:
        return np.array([number_of(cell, decimal) if cell else np.nan for cell in cells])
    except ValueError:
        return None
