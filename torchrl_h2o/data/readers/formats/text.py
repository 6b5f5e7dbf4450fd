"""Split the text of a log into cells and convert these to numbers, with errors that name the line and column."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.formats.raw_table import RawTable, require_names

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_Row = tuple[int, list[str]]  # line number, counted from 1, and cells


def read_text(path: Path, layout: LogColumns | None) -> RawTable:
    """Read a text file.

    Args:
        path: the file.
        layout: separator, header, comment and decimal.

    Raises:
        DataError: for a file that is not text, a line that cannot be split, fewer than two rows, or rows of different
            lengths. The returned table raises it for a cell that is not a number.
    """
    if layout is None:
        raise DataError("a text file does not describe its columns", "give a column description", source=path)
    rows = _rows(path, layout)
    names, header_row = None, None
    if layout.header and rows:
        header_row, cells = rows.pop(0)
        names = [cell.strip("\"'") for cell in cells]
        require_names(names, layout, path, header_row)
    if len(rows) < 2:
        raise DataError(
            f"there are {len(rows)} rows of data",
            "a transition needs two: the file is empty or truncated",
            source=path,
        )

    def numbers(indices: Sequence[int], names: Sequence[str]) -> np.ndarray:
        return _numbers([[cells[i] for i in indices] for _, cells in rows], names, rows, layout.decimal, path)

    lines = np.array([number for number, _ in rows])
    if names is None:
        expected = [column.name for column in layout.in_file]
        width = len(rows[0][1]) if layout.by_index else len(expected)
        _require_width(rows, [*expected, *(f"column {i + 1}" for i in range(len(expected), width))][:width], path)
        return RawTable(path, None, width, lines, numbers)
    _require_width(rows, names, path)
    return RawTable(path, tuple(names), len(names), lines, numbers)


def _rows(path: Path, layout: LogColumns) -> list[_Row]:
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise DataError(f"the file is not text: {error}", "give a text or CSV file", source=path) from error
    # blank lines and comments are skipped but counted, so that row numbers are line numbers
    return [
        (number, _cells(line, layout.separator, path, number))
        for number, line in enumerate(lines, start=1)
        if line.strip() and not (layout.comment and line.lstrip().startswith(layout.comment))
    ]


def _cells(line: str, separator: str, path: Path, number: int) -> list[str]:
    if separator == "whitespace":
        return line.split()
    try:
        # skipinitialspace, so that a quote after a space is recognised
        skip = separator != " "
        (cells,) = csv.reader([line.rstrip("\r")], delimiter=separator, skipinitialspace=skip, strict=True)
    except csv.Error as error:
        raise DataError(
            f"the line cannot be split into cells: {error}",
            "correct its quotes; a cell cannot span lines",
            source=path,
            row=number,
        ) from error
    return [cell.strip() for cell in cells]


def _require_width(rows: list[_Row], names: Sequence[str], path: Path) -> None:
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


def _numbers(cells: list[list[str]], names: Sequence[str], rows: list[_Row], decimal: str, path: Path) -> np.ndarray:
    values = np.empty((len(cells), len(names)))
    for index, row in enumerate(cells):
        for position, cell in enumerate(row):
            try:
                values[index, position] = number_of(cell, decimal)
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
    # float() would read 1_5 as 15; in a file with decimal commas, a point may separate thousands
    if "_" in cell or (decimal == "," and "." in cell):
        raise ValueError
    return float(cell.replace(",", ".") if decimal == "," else cell)
