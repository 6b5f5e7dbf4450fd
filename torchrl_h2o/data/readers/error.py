"""The exception of all readers, and the check for finite values.

A reader either returns the whole data set or raises :class:`DataError`, which names the file, column and row of the
invalid value and a remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike

import numpy as np

_LONGEST = 300  # characters of a message without its source
_LONGEST_REMEDY = 170
_LONGEST_COLUMN = 60  # a damaged file may have names of any length


class DataError(ValueError):
    """Invalid data, with its location and a remedy.

    Args:
        problem: the problem, with the invalid value; put on one line.
        remedy: how to correct it. The message has at most 300 characters without the source; longer ones are cut.
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
        source: str | PathLike[str] | None = None,
        column: str | None = None,
        row: int | None = None,
    ):
        self.source = None if source is None else str(source)
        self.column = column
        self.row = row
        place = [
            self.source,
            None if column is None else f"column {_one_line(repr(column), _LONGEST_COLUMN)}",
            None if row is None else f"row {row}",
        ]
        where = ", ".join(part for part in place if part)
        remedy = _one_line(remedy, _LONGEST_REMEDY)
        begin = f"{where}: " if where else ""
        problem = _one_line(problem, _LONGEST - len(begin) + len(self.source or "") - len(f"; {remedy}"))
        super().__init__(f"{begin}{problem}; {remedy}")


@contextmanager
def unreadable(
    problem: str,
    remedy: str = "copy or export the file again",
    *,
    source: str | PathLike[str],
    column: str | None = None,
) -> Iterator[None]:
    """Raise DataError in place of any other exception of the block.

    The packages that read a file format raise exceptions of many types for a damaged file, so all types are replaced.

    Args:
        problem: what failed, such as "the file cannot be read"; the message adds the text of the exception.
        remedy: how to correct it.
        source: the file.
        column: the part of the file that is read.

    Raises:
        DataError: for any exception of the block; one that is a DataError already is passed on.

    Example:
        >>> from torchrl_h2o.data.readers.error import unreadable
        >>> with unreadable("the file cannot be read", source="a.csv"):
        ...     float("x")
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: a.csv: the file cannot be read: could not convert string to float: ...
    """
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        cause = str(error) or type(error).__name__
        raise DataError(f"{problem}: {cause}", remedy, source=source, column=column) from error


def _one_line(text: str, most: int) -> str:
    """The text without line breaks and invisible characters, cut in the middle to a number of characters."""
    text = " ".join("".join(sign if sign.isprintable() else " " for sign in text).split())
    first = 2 * most // 3
    return text if len(text) <= most else f"{text[:first]} ... {text[first + 5 - most :]}"


def require_finite(
    values: np.ndarray,
    columns: Sequence[str],
    *,
    source: str | PathLike[str],
    row_of: Callable[[int], int] = lambda index: index + 1,
    largest: float = float(np.finfo(np.float32).max),
) -> None:
    """Raise DataError at the first value, row by row, that is NaN, or beyond the largest plausible one.

    Args:
        values: values of shape (rows, columns).
        columns: one name per column.
        source: the file of the values.
        row_of: converts an index to the row number for the message.
        largest: the largest plausible size of a value; by default, that of float32.

    Raises:
        DataError: with file, column and row.
    """
    plausible = np.abs(values) <= largest  # false for NaN
    if plausible.all():
        return
    index, position = np.argwhere(~plausible)[0]
    raise DataError(
        f"the value is {values[index, position]}{', a missing number' if np.isnan(values[index, position]) else ''}",
        f"every value must be finite and at most {largest:.3g}: correct it or its unit, remove the row and those that "
        "depend on it, or ignore the column",
        source=source,
        column=columns[int(position)],
        row=row_of(int(index)),
    )


def require_real(values: np.ndarray, column: str, *, source: str | PathLike[str]) -> None:
    """Raise DataError unless an array holds real numbers or booleans.

    A complex number would lose its imaginary part in the conversion to float32.

    Args:
        values: any array.
        column: its name.
        source: the file of the values.

    Raises:
        DataError: for complex numbers, text, objects or structures.
    """
    if values.dtype.kind not in "fiub":
        raise DataError(
            f"the values are {values.dtype}, expected real numbers",
            "write them as real numbers",
            source=source,
            column=column,
        )


def require_flags(
    values: np.ndarray,
    column: str,
    *,
    source: str | PathLike[str],
    row_of: Callable[[int], int] = lambda index: index + 1,
) -> np.ndarray:
    """Return flags as booleans.

    Args:
        values: flags, (T,), each 0 or 1.
        column: their name.
        source: the file of the values.
        row_of: converts an index to the row number for the message.

    Raises:
        DataError: for any other value, such as 2, 0.5 or NaN, with its row.
    """
    require_real(values, column, source=source)
    wrong = np.flatnonzero((values != 0) & (values != 1))
    if len(wrong):
        raise DataError(
            f"the flag is {values[wrong[0]]}",
            "it must be 0 or 1",
            source=source,
            column=column,
            row=row_of(int(wrong[0])),
        )
    return values.astype(bool)
