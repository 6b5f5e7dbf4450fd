"""Select the columns of a log that its layout describes, and convert them to SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from os import PathLike
from typing import cast

import numpy as np

from torchrl_h2o.data.readers.error import DataError, require_finite
from torchrl_h2o.data.readers.formats import read_raw
from torchrl_h2o.data.readers.formats.raw_table import RawTable
from torchrl_h2o.data.readers.held_actions import hold_actions
from torchrl_h2o.data.readers.log_columns import Column, LogColumns

# the largest plausible value in SI: beyond 2³² counts of an encoder and the seconds since 1970, below what a lost
# decimal point makes of 15 digits
LARGEST = 1e12


@dataclass(frozen=True)
class LogTable:
    """The numbers of a log.

    Args:
        source: the file.
        names: names of the columns that are not ignored, in the file's order.
        values: values in SI, float64, (rows, columns).
        rows: number of each row, counted from 1; the line number in text files, (rows,).
        zero_rows: number of rows of zeros that were dropped at the end of the file.
        noise: standard deviation of the noise of columns whose noise the values do not show, because they were
            interpolated, in SI.
    """

    source: str
    names: tuple[str, ...]
    values: np.ndarray
    rows: np.ndarray
    zero_rows: int
    noise: Mapping[str, float] = field(default_factory=dict)

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Return the named columns in the given order, (rows, len(names))."""
        return self.values[:, [self.names.index(name) for name in names]]


def read_table(path: str | PathLike[str], layout: LogColumns) -> LogTable:
    """Read and check the numbers of a log.

    Args:
        path: the log.
        layout: the meaning of its columns.

    Returns:
        The table, converted to SI. Ignored columns are not parsed. Empty cells of actions hold the last value, see
        :func:`~torchrl_h2o.data.readers.held_actions.hold_actions`.

    Raises:
        DataError: for a missing, binary, empty or truncated file, missing or extra columns, a cell that is not a
            number, a reading that is NaN, or a value beyond :data:`LARGEST`.

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
    raw = read_raw(path, layout)
    chosen = _chosen(raw, layout)
    names = [column.name for _, column in chosen]
    values = raw.numbers([index for index, _ in chosen], names)
    numbers, zero_rows = raw.rows, 0
    if layout.drop_trailing_zero_rows:
        filled = np.flatnonzero((values != 0).any(1))
        zero_rows = len(values) - (filled[-1] + 1 if len(filled) else 0)
        values, numbers = values[: len(values) - zero_rows], numbers[: len(values) - zero_rows]
    if len(values) < 2:
        raise DataError("only rows of zeros remain", "record the log again", source=raw.source)
    values, kept = hold_actions(values, [column for _, column in chosen], str(raw.source))
    numbers = numbers[kept]
    try:
        values = np.stack([column.in_si(values[:, index]) for index, (_, column) in enumerate(chosen)], axis=1)
    except ValueError as error:
        raise DataError(str(error), "correct the column description", source=raw.source) from error
    require_finite(values, names, source=raw.source, row_of=lambda index: int(numbers[index]), largest=LARGEST)
    return LogTable(str(raw.source), tuple(names), values, numbers, int(zero_rows))


def _chosen(raw: RawTable, layout: LogColumns) -> list[tuple[int, Column]]:
    """Return the columns that are not ignored, with their positions in the file, in the file's order."""
    if layout.by_index:
        placed = [(cast("int", column.index), column) for column in layout.in_file]
        _require_indices(placed, raw, layout)
    elif raw.names is None:
        placed = list(enumerate(layout.in_file))
    else:
        placed = [(raw.names.index(column.name), column) for column in layout.in_file]
    return [(index, column) for index, column in sorted(placed, key=itemgetter(0)) if column.role != "ignore"]


def _require_indices(placed: list[tuple[int, Column]], raw: RawTable, layout: LogColumns) -> None:
    for index, column in placed:
        if index >= raw.width:
            raise DataError(
                f"its index is {index}, but the file has {raw.width} columns",
                "count from 0, and check the separator",
                source=raw.source,
                column=column.name,
            )
    if layout.other_columns == "error" and len(placed) < raw.width:
        missing = sorted(set(range(raw.width)) - {index for index, _ in placed})
        raise DataError(
            f"the columns {', '.join(map(str, missing))} are not described",
            "describe them (with the role ignore if not needed), or set other_columns: ignore",
            source=raw.source,
        )
