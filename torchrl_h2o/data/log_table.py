"""Turn the text of a log into numbers in SI, or say in which line and column it is not one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.data.error import DataError, require_finite
from torchrl_h2o.data.file_kind import require_file
from torchrl_h2o.data.log_columns import LogColumns


@dataclass(frozen=True)
class LogTable:
    """The numbers of a log.

    Args:
        source: the file.
        names: the columns that are read, in the file's order.
        values: shape (rows, columns), float64, in SI.
        rows: shape (rows,), the line number of each row, counted from 1.
        zero_rows: how many rows of zeros were left out at the end.
    """

    source: str
    names: tuple[str, ...]
    values: np.ndarray
    rows: np.ndarray
    zero_rows: int

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """The named columns in that order, shape (rows, len(names))."""
        return self.values[:, [self.names.index(name) for name in names]]


def read_table(path: str, layout: LogColumns) -> LogTable:
    """Read a log's numbers and check every one of them.

    Args:
        path: the log.
        layout: what its columns are.

    Returns:
        the table, converted to SI; columns that are ignored are not looked at.

    Raises:
        DataError: no file, no text, an empty or cut-off file, missing or extra columns, what is
            no number, NaN or infinity.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data import Column, LogColumns
        >>> from torchrl_h2o.data.log_table import read_table
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
        raise DataError(f"this is no text: {error}", "give a text or CSV file", source=path) from error
    separator = None if layout.separator == "whitespace" else layout.separator
    # blank lines are skipped and still counted, as in an editor
    rows = [
        (number, [cell.strip() for cell in line.split(separator)])
        for number, line in enumerate(lines, start=1)
        if line.strip()
    ]
    names = [column.name for column in layout.columns]
    if layout.header and rows:
        names = _require_names(rows.pop(0), names, path)
    if len(rows) < 2:
        raise DataError(
            f"there are {len(rows)} rows of data",
            "two make a transition: the file is empty or cut off",
            source=path,
        )
    _require_width(rows, names, path)
    by_name = {column.name: column for column in layout.columns}
    kept = [i for i, name in enumerate(names) if by_name[name].role != "ignore"]
    names = [names[i] for i in kept]
    values = _numbers([[cells[i] for i in kept] for _, cells in rows], names, rows, path)
    numbers = np.array([number for number, _ in rows])
    zero_rows = 0
    if layout.drop_trailing_zero_rows:
        filled = np.flatnonzero((values != 0).any(1))
        zero_rows = len(values) - (filled[-1] + 1 if len(filled) else 0)
        values, numbers = values[: len(values) - zero_rows], numbers[: len(values) - zero_rows]
    if len(values) < 2:
        raise DataError("only rows of zeros are left", "record it again", source=path)
    values = values * np.array([by_name[name].factor for name in names])
    require_finite(values, names, source=path, row_of=lambda index: int(numbers[index]))
    return LogTable(str(path), tuple(names), values, numbers, int(zero_rows))


def _require_names(header: tuple[int, list[str]], expected: list[str], path) -> list[str]:
    number, cells = header
    names = [cell.strip("\"'") for cell in cells]
    remedy = f"the header is {', '.join(names)}; correct the file or its column description"
    for name in names:
        if names.count(name) > 1:
            problem = "two columns have this name"
        elif name not in expected:
            problem = "the column is not described (the role ignore leaves it out)"
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
        found = f"the row has {len(cells)} columns, {len(names)} are described"
        if len(cells) > len(names):
            raise DataError(
                f"{found}; extra: {', '.join(cells[len(names) :])}",
                "describe them (the role ignore leaves them out), or check the separator",
                column=f"column {len(names) + 1}",
                **place,
            )
        place["column"] = names[len(cells)]
        if number == rows[-1][0] and len(rows) > 1:
            raise DataError(f"{found}, and it is the last", "the file is cut off", **place)
        raise DataError(f"{found}; missing", "correct the row, or check the separator", **place)


def _numbers(cells: list[list[str]], names: list[str], rows: list[tuple[int, list[str]]], path) -> np.ndarray:
    try:
        return np.array([list(map(float, row)) for row in cells])
    except ValueError:
        for (number, _), row in zip(rows, cells, strict=True):
            for name, cell in zip(names, row, strict=True):
                try:
                    float(cell)
                except ValueError:
                    raise DataError(
                        f"{cell!r} is no number",
                        "correct it, or check separator and header",
                        source=path,
                        column=name,
                        row=number,
                    ) from None
        raise
