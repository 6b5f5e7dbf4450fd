"""What a log shows of itself: separator, header, decimal sign, names and values of its columns."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.formats import FORMATS, read_raw
from torchrl_h2o.data.readers.formats.text import number_of, read_text

_LINES = 50_000  # lines of a text file that are looked at, to find gaps and jumps behind its beginning


@dataclass(frozen=True)
class Contents:
    """The columns of a log.

    Args:
        values: the numbers of each column by name; None for a column that is not numbers.
        options: entries of the layout that describe the file, such as ``separator``.
        named: whether the names are in the file.
    """

    values: dict[str, np.ndarray | None]
    options: dict[str, str] = field(default_factory=dict)
    named: bool = True


def read_contents(path: str | Path) -> Contents:
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
    path = require_file(path)
    if FORMATS.get(path.suffix.lower(), read_text) is not read_text:
        raw = read_raw(path)
        values = {name: _numbers(raw, index, name) for index, name in enumerate(raw.names or ())}
        topic = {"topic": f'"{raw.topic}"'} if raw.topic else {}
        return Contents(values, {"header": "true", **topic})
    try:
        with path.open(encoding="utf-8-sig") as file:
            lines = [line for line, _ in zip(file, range(_LINES), strict=False) if line.strip()]
    except UnicodeDecodeError as error:
        raise DataError("the file is not text", "give a log", source=path) from error
    return _text(lines, path)


def _numbers(raw, index: int, name: str) -> np.ndarray | None:
    try:
        return raw.numbers([index], [name])[:, 0]
    except DataError:
        return None


def _text(lines: list[str], path: Path) -> Contents:
    marks = [mark for mark in ("#", "%") if lines and lines[0].startswith(mark)]
    rows = [line for line in lines if not (marks and line.lstrip().startswith(marks[0]))]
    separator = _separator(rows)
    cells = [_split(line, separator) for line in rows]
    decimal = "," if separator != "," and any("," in cell for row in cells[1:3] for cell in row) else "."
    header = bool(cells) and not any(_is_number(cell, decimal) for cell in cells[0])
    names, body = (cells[0], cells[1:]) if header else ([], cells)
    body = [row for row in body if len(row) == len(body[0])]
    if len(body) < 2:
        raise DataError("no two rows of numbers were found", "give a log, one row per time step", source=path)
    options = {"separator": "whitespace" if separator is None else f'"{separator}"'.replace("\t", "\\t")}
    options |= {"header": str(header).lower()} | ({"decimal": '","'} if decimal == "," else {})
    if marks:
        options["comment"] = f'"{marks[0]}"'
        said = _split(lines[0].lstrip(marks[0]).strip(), separator)  # as numpy.savetxt writes names
        names = names or (said if len(said) == len(body[0]) and len(set(said)) == len(said) else [])
    unnamed = not names
    names = [f"column_{i}" for i in range(len(body[0]))] if unnamed else names
    columns = zip(*body, strict=True)
    values = {name: _column(column, decimal) for name, column in zip(names, columns, strict=False)}
    if not any(column is not None for column in values.values()):
        raise DataError("no column of numbers was found", "give a log, one row per time step", source=path)
    return Contents(values, options, not unnamed)


def _separator(rows: list[str]) -> str | None:
    """The sign that splits all of the first rows into the same number of cells, of at least two; None for blanks."""
    for sign in ("\t", ";", ","):
        counts = {row.count(sign) for row in rows[:50]}
        if len(counts) == 1 and counts != {0}:
            return sign
    return None


def _split(line: str, separator: str | None) -> list[str]:
    cells = line.split() if separator is None else line.strip("\r\n").split(separator)
    return [cell.strip().strip("\"'") for cell in cells]


def _is_number(cell: str, decimal: str) -> bool:
    try:
        number_of(cell, decimal)
    except ValueError:
        return False
    return True


def _column(cells: tuple[str, ...], decimal: str) -> np.ndarray | None:
    return (
        np.array([number_of(cell, decimal) for cell in cells]) if all(_is_number(c, decimal) for c in cells) else None
    )
