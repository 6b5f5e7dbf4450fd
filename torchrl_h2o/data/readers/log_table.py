"""Convert the text of a log to numbers in SI, with errors that name the line and column."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchrl_h2o.data.readers.error import DataError, require_finite
from torchrl_h2o.data.readers.file_kind import require_file
from torchrl_h2o.data.readers.log_columns import LogColumns


@dataclass(frozen=True)
class LogTable:
    """The numbers of a log.

    Args:
        source: the file.
        names: names of the columns that are not ignored, in the file's order.
        values: values in SI, float64, (rows, columns).
        rows: line number of each row, counted from 1, (rows,).
        zero_rows: number of rows of zeros that were dropped at the end of the file.
    """

    source: str
    names: tuple[str, ...]
    values: np.ndarray
    rows: np.ndarray
    zero_rows: int

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Return the named columns in the given order, (rows, len(names))."""
        return self.values[:, [self.names.index(name) for name in names]]


def read_table(path: str | Path, layout: LogColumns) -> LogTable:
    """Read and check the numbers of a log.

    Args:
        path: the log.
        layout: the meaning of its columns.

    Returns:
        The table, converted to SI. Ignored columns are not parsed.

    Raises:
        DataError: for a missing, binary, empty or truncated file, missing or extra columns, a cell that is not a
            number, NaN or infinity.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data import Column, LogColumns
        >>> from torchrl_h2o.data.readers.log_table import read_table
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> _ = path.write_text("torque,speed\\n1,60\\n2,120\\n")
        >>> layout = LogColumns(
        ...     (Column("speed", "observation", "rpm"), Column("torque", "action", "mN·m")),
        ...     dt=0.01, separator=",", header=True)
        >>> read_table(path, layout).columns(["torque"]).tolist()
        [[0.001], [0.002]]
    """
    path = require_file(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise DataError(f"the file is not text: {error}", "give a text or CSV file", source=path) from error
    # blank lines and comments are skipped but counted, so that row numbers are line numbers
    rows = [
        (number, _cells(line, layout.separator, path, number))
        for number, line in enumerate(lines, start=1)
        if line.strip() and not (layout.comment and line.lstrip().startswith(layout.comment))
    ]
    names = [column.name for column in layout.columns]
    if layout.header and rows:
        names = _require_names(rows.pop(0), names, path, layout.other_columns == "ignore")
    if len(rows) < 2:
        raise DataError(
            f"there are {len(rows)} rows of data",
            "a transition needs two: the file is empty or truncated",
            source=path,
        )
    _require_width(rows, names, path)
    by_name = {column.name: column for column in layout.columns}
    kept = [i for i, name in enumerate(names) if name in by_name and by_name[name].role != "ignore"]
    names = [names[i] for i in kept]
    values = _numbers([[cells[i] for i in kept] for _, cells in rows], names, rows, layout.decimal, path)
    numbers = np.array([number for number, _ in rows])
    zero_rows = 0
    if layout.drop_trailing_zero_rows:
        filled = np.flatnonzero((values != 0).any(1))
        zero_rows = len(values) - (filled[-1] + 1 if len(filled) else 0)
        values, numbers = values[: len(values) - zero_rows], numbers[: len(values) - zero_rows]
    if len(values) < 2:
        raise DataError("only rows of zeros remain", "record the log again", source=path)
    values = values * np.array([by_name[name].factor for name in names])
    require_finite(values, names, source=path, row_of=lambda index: int(numbers[index]))
    return LogTable(str(path), tuple(names), values, numbers, int(zero_rows))


def _cells(line: str, separator: str, path, number: int) -> list[str]:
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


def _require_names(header: tuple[int, list[str]], expected: list[str], path, ignore_others: bool) -> list[str]:
    number, cells = header
    names = [cell.strip("\"'") for cell in cells]
    remedy = f"the header is {', '.join(names)}; correct the file or its column description"
    for name in names:
        if ignore_others and name not in expected:
            continue
        if names.count(name) > 1:
            problem = "two columns have this name"
        elif name not in expected:
            problem = "the column is not described (use role: ignore, or other_columns: ignore for all such columns)"
        else:
            continue
        raise DataError(problem, remedy, source=path, column=name, row=number)
    for name in expected:
        if name not in names:
            raise DataError("the column is missing", remedy, source=path, column=name, row=number)
    return names


def _require_width(rows: list[tuple[int, list[str]]], names: list[str], path) -> None:
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


def _numbers(
    cells: list[list[str]], names: list[str], rows: list[tuple[int, list[str]]], decimal: str, path
) -> np.ndarray:
    values = np.empty((len(cells), len(names)))
    for index, row in enumerate(cells):
        for position, cell in enumerate(row):
            try:
                values[index, position] = _number(cell, decimal)
            except ValueError:
                raise DataError(
                    f"{cell!r} is not a number",
                    f"correct it, or check separator, header and decimal ({decimal!r})",
                    source=path,
                    column=names[position],
                    row=rows[index][0],
                ) from None
    return values


def _number(cell: str, decimal: str) -> float:
    # float() would read 1_5 as 15; in a file with decimal commas, a point may separate thousands
    if "_" in cell or (decimal == "," and "." in cell):
        raise ValueError
    return float(cell.replace(",", ".") if decimal == "," else cell)
