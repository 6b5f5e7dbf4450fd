"""The exception of all readers, and the check for finite values.

A reader either returns the whole data set or raises :class:`DataError`, which names the file, column and row of the
invalid value and a remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np


class DataError(ValueError):
    """Invalid data, with its location and a remedy.

    Args:
        problem: the problem, with the invalid value.
        remedy: how to correct it.
        source: the file, folder or dataset name; also an attribute.
        column: the column's name, or the path inside a file; also an attribute.
        row: the row, counted from 1 (in text files, the line number); also an attribute.

    Example:
        >>> from torchrl_h2o.data import DataError
        >>> print(DataError("not a number: 'x'", "correct it", source="a.csv", column="v", row=3))
        a.csv, column 'v', row 3: not a number: 'x'; correct it
    """

    def __init__(
        self,
        problem: str,
        remedy: str,
        *,
        source: str | Path | None = None,
        column: str | None = None,
        row: int | None = None,
    ):
        self.source = None if source is None else str(source)
        self.column = column
        self.row = row
        place = [
            self.source,
            None if column is None else f"column {column!r}",
            None if row is None else f"row {row}",
        ]
        where = ", ".join(part for part in place if part)
        super().__init__(f"{where + ': ' if where else ''}{problem}; {remedy}")


def require_finite(
    values: np.ndarray,
    columns: Sequence[str],
    *,
    source: str | Path,
    row_of: Callable[[int], int] = lambda index: index + 1,
) -> None:
    """Raise DataError at the first value, row by row, that is NaN or infinite in float32.

    Args:
        values: values of shape (rows, columns).
        columns: one name per column.
        source: the file of the values.
        row_of: converts an index to the row number for the message.

    Raises:
        DataError: with file, column and row.

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data.readers.error import require_finite
        >>> require_finite(np.array([[0.0, np.nan]]), ["x", "v"], source="a.csv")
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: a.csv, column 'v', row 1: the value is nan; ...
    """
    with np.errstate(over="ignore"):  # 1e300 is finite in float64 and infinite in float32
        bad = ~np.isfinite(values.astype(np.float32))
    if not bad.any():
        return
    index, position = np.argwhere(bad)[0]
    raise DataError(
        f"the value is {values[index, position]}",
        "every value must be finite in float32: remove the row and the rows that depend on it, or ignore the column",
        source=source,
        column=columns[int(position)],
        row=row_of(int(index)),
    )
