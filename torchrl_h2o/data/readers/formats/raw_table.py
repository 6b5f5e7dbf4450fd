"""The columns of a log as its file names them, and the conversion of binary columns to numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_h2o.data.readers.error import DataError, require_real

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_SECOND = np.timedelta64(1, "s")


@dataclass(frozen=True)
class RawTable:
    """The columns of a file.

    Args:
        source: the file.
        names: the names in the file's order; None for a text file without a header.
        width: number of columns.
        rows: number of each row for errors, counted from 1; the line number in text files, (rows,).
        numbers: ``numbers(indices, names) -> (rows, len(indices))``, float64: the values of columns; the names are for
            errors.
        topic: the topic whose messages are the rows of a bag, if several have joint states.
    """

    source: str | PathLike[str]
    names: tuple[str, ...] | None
    width: int
    rows: np.ndarray
    numbers: Callable[[Sequence[int], Sequence[str]], np.ndarray]
    topic: str | None = None


def table_of(
    columns: dict[str, Callable[[], np.ndarray]], length: int, path: Path, layout: LogColumns | None
) -> RawTable:
    """Return a table of named columns that are read when they are asked for.

    Args:
        columns: the reader of each column's values, (length,).
        length: number of rows.
        path: the file.
        layout: the described columns, which must be in the file; None allows all.
    """
    names = tuple(columns)
    require_names(names, layout, path)

    def numbers(indices: Sequence[int], chosen: Sequence[str]) -> np.ndarray:
        parts = [as_numbers(columns[names[index]](), name, path) for index, name in zip(indices, chosen, strict=True)]
        return np.stack(parts, axis=1) if parts else np.zeros((length, 0))

    return RawTable(path, names, len(names), np.arange(1, length + 1), numbers)


def columns_of(name: str, values: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    """Return the columns of an array by name: itself, or ``name[0]`` and so on for an array of two dimensions.

    Args:
        name: the array's name.
        values: the array, (rows,) or (rows, n).
    """
    if values.ndim == 1:
        return {name: partial(np.asarray, values)}
    return {f"{name}[{i}]": partial(np.asarray, values[:, i]) for i in range(values.shape[1])}


def require_names(
    names: Sequence[str], layout: LogColumns | None, path: str | PathLike[str], row: int | None = None
) -> None:
    """Raise DataError unless the names of a file's columns are those of a layout.

    Args:
        names: the names in the file.
        layout: the described columns; None allows all.
        path: the file.
        row: line of the header in a text file.
    """
    if layout is None or layout.by_index:
        return
    expected = [column.name for column in layout.in_file]
    remedy = f"the header is {_listed(names)}; correct the file or its column description"
    for name in names:
        if layout.other_columns == "ignore" and name not in expected:
            continue
        if list(names).count(name) > 1:
            problem = "two columns have this name"
        elif name not in expected:
            problem = "the column is not described (use role: ignore, or other_columns: ignore for all such columns)"
        else:
            continue
        raise DataError(problem, remedy, source=path, column=name, row=row)
    for name in expected:
        if name not in names:
            raise DataError("the column is missing", remedy, source=path, column=name, row=row)


def _listed(names: Sequence[str]) -> str:
    most = 40
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def as_numbers(values: np.ndarray, column: str, path: Path) -> np.ndarray:
    """Convert the values of one column to float64; a date becomes the time in s since the midnight before the first
    row, which files of one run have in common.

    Raises:
        DataError: for complex numbers, text and objects.
    """
    if values.dtype.kind in "Mm":
        return (values - values[0].astype("datetime64[D]")) / _SECOND if values.dtype.kind == "M" else values / _SECOND
    require_real(values, column, source=path)
    return values.astype(np.float64)


def require_package(name: str, path: Path) -> None:
    """Raise DataError if the package of a file format is not installed."""
    from importlib.util import find_spec

    if find_spec(name) is None:
        extra = "mcap" if name.startswith("mcap") else "logs"
        raise DataError(
            f"reading {path.suffix} files needs the package {name}",
            f"pip install 'torchrl_h2o[{extra}]'",
            source=path,
        )
