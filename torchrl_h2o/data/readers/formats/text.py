"""Split the text of a log into cells and convert these to numbers, with errors that name the line and column."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_h2o.data.readers.error import DataError, unreadable
from torchrl_h2o.data.readers.formats.raw_table import RawTable, require_names

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

Row = tuple[int, list[str]]  # line number, counted from 1, and cells
_LIST = re.compile(r"\s*[\[(](.*)[\])]\s*", re.DOTALL)  # as Python and many loggers write vectors
_COMPARED = 1000  # rows with which the last cell of a file is compared


def read_text(path: Path, layout: LogColumns | None) -> RawTable:
    """Read a text file. A column of lists, such as ``"[0.1, 0.2]"``, becomes ``name[0]`` and so on; an empty cell, NaN.

    Args:
        path: the file.
        layout: separator, header, comment and decimal.

    Raises:
        DataError: for a file that is not text, a line that cannot be split, fewer than two rows, or rows of different
            lengths. The returned table raises it for a cell that is not a number or that may be cut.
    """
    if layout is None:
        raise DataError("a text file does not describe its columns", "give a column description", source=path)
    with unreadable("the file is not text", "give a text or CSV file", source=path):
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    rows = split_rows(lines, layout.separator, layout.comment, path)
    names, header_row = None, None
    if layout.header and rows:
        header_row, cells = rows.pop(0)
        names = [cell.strip("\"'") for cell in cells]
    names, rows = with_lists(names, rows)
    if names is not None:
        require_names(names, layout, path, header_row)
    if len(rows) < 2:
        raise DataError(
            f"there are {len(rows)} rows of data",
            "a transition needs two: the file is empty or truncated",
            source=path,
        )
    expected = names or [column.name for column in layout.in_file]
    width = len(rows[0][1]) if names is None and layout.by_index else len(expected)
    _require_width(rows, [*expected, *(f"column {i + 1}" for i in range(len(expected), width))][:width], path)
    is_open = bool(lines[-1].strip()) and rows[-1][0] == len(lines)  # no line break ends the last row

    def numbers(indices: Sequence[int], names: Sequence[str]) -> np.ndarray:
        if is_open and width - 1 in indices:
            _require_whole_end(rows, lines[-1], names[list(indices).index(width - 1)], path)
        return _numbers([[cells[i] for i in indices] for _, cells in rows], names, rows, layout.decimal, path)

    return RawTable(path, None if names is None else tuple(names), width, np.array([row for row, _ in rows]), numbers)


def split_rows(lines: Sequence[str], separator: str, comment: str | None, path: Path) -> list[Row]:
    """Split lines into cells; blank lines and comments are skipped but counted, so that row numbers are line numbers.

    Raises:
        DataError: for broken quotes, with the line.
    """
    return [
        (number, _cells(line, separator, path, number))
        for number, line in enumerate(lines, start=1)
        if line.strip() and not (comment and line.lstrip().startswith(comment))
    ]


def _cells(line: str, separator: str, path: Path, number: int) -> list[str]:
    if separator == "whitespace":
        return line.split()
    try:
        # skipinitialspace, so that a quote after a space is recognised
        skip = separator != " "
        (cells,) = csv.reader([line.rstrip("\r\n")], delimiter=separator, skipinitialspace=skip, strict=True)
    except csv.Error as error:
        raise DataError(
            f"the line cannot be split into cells: {error}",
            "correct its quotes; a cell cannot span lines",
            source=path,
            row=number,
        ) from error
    return [cell.strip() for cell in cells]


def with_lists(names: list[str] | None, rows: list[Row]) -> tuple[list[str] | None, list[Row]]:
    """Put each number of cells that hold lists into a cell of its own; columns whose lists differ in length stay.

    Args:
        names: the columns' names, if the file has them.
        rows: the rows of data.

    Example:
        >>> from torchrl_h2o.data.readers.formats.text import with_lists
        >>> with_lists(["t", "q"], [(2, ["0.1", "[1, 2]"]), (3, ["0.2", "[3, 4]"])])
        (['t', 'q[0]', 'q[1]'], [(2, ['0.1', '1', '2']), (3, ['0.2', '3', '4'])])
    """
    inner: dict[int, list[list[str]]] = {}
    for index, cell in enumerate(rows[0][1] if rows else ()):
        if _LIST.fullmatch(cell):
            found = [_LIST.fullmatch(cells[index]) for _, cells in rows if index < len(cells)]
            parts = [match[1].replace(",", " ").replace(";", " ").split() if match else [] for match in found]
            if len({len(part) for part in parts}) == 1 and parts[0]:
                inner[index] = parts
    if not inner:
        return names, rows
    if names is not None:
        names = [
            new
            for index, name in enumerate(names)
            for new in ([f"{name}[{i}]" for i in range(len(inner[index][0]))] if index in inner else [name])
        ]
    return names, [
        (number, [new for index, cell in enumerate(cells) for new in (inner[index][i] if index in inner else [cell])])
        for i, (number, cells) in enumerate(rows)
    ]


def _require_whole_end(rows: list[Row], line: str, name: str, path: Path) -> None:
    """Raise DataError if the last cell may be cut: no line break follows, and others of its column are longer.

    A cell is whole if it has the decimals that all others have, or is as long as the longest.
    """
    *others, last = [cells[-1].lstrip("+-") for _, cells in rows[-_COMPARED:]]
    decimals = {len(cell.partition(".")[2]) for cell in others}
    whole = decimals == {len(last.partition(".")[2])} != {0} or len(last) >= max(map(len, others))
    if not whole and line.rstrip()[-1] not in "\"')]":
        raise DataError(
            f"the file ends in {last!r} without a line break, so this number may be cut",
            "remove the row; or, if it is whole, end the file with a line break",
            source=path,
            column=name,
            row=rows[-1][0],
        )


def _require_width(rows: list[Row], names: Sequence[str], path: Path) -> None:
    for number, cells in rows:
        if len(cells) == len(names):
            continue
        place = {"source": path, "row": number}
        found = f"the row has {len(cells)} columns, {len(names)} are expected"
        if len(cells) > len(names):
            raise DataError(
                f"{found}; extra: {', '.join(cells[len(names) :])}",
                "describe them (with the role ignore if not needed), or check the separator",
                column=f"column {len(names) + 1}",
                **place,
            )
        place["column"] = names[len(cells)]
        if number == rows[-1][0] and len(rows) > 1:
            raise DataError(f"{found}, and it is the last row", "the file is truncated", **place)
        raise DataError(f"{found}; missing", "correct the row, or check the separator", **place)


def _numbers(cells: list[list[str]], names: Sequence[str], rows: list[Row], decimal: str, path: Path) -> np.ndarray:
    values = np.empty((len(cells), len(names)))
    for index, row in enumerate(cells):
        for position, cell in enumerate(row):
            try:
                values[index, position] = number_of(cell, decimal) if cell else np.nan
            except ValueError:
                raise DataError(
                    f"{cell!r} is not a number",
                    f"correct it, or check separator, header and decimal ({decimal!r})",
                    source=path,
                    column=names[position],
                    row=rows[index][0],
                ) from None
    return values


def number_of(cell: str, decimal: str) -> float:
    """Convert a cell to a number.

    Raises:
        ValueError: if it is none.

    Example:
        >>> from torchrl_h2o.data.readers.formats.text import number_of
        >>> number_of("1,5", ",")
        1.5
    """
    # float() would read 1_5 as 15, and digits of other scripts; beside decimal commas, a point may separate thousands
    if "_" in cell or not cell.isascii() or (decimal == "," and "." in cell):
        raise ValueError
    return float(cell.replace(",", ".") if decimal == "," else cell)
