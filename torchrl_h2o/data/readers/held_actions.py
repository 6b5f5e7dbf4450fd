"""Actions at another rate than the readings of their file: the rows are the readings', and an action holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torchrl import torchrl_logger

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.log_columns import Column


def hold_actions(values: np.ndarray, columns: Sequence[Column], source: str) -> tuple[np.ndarray, np.ndarray]:
    """Fill empty cells of actions with the value before, and leave out rows that have actions but no readings.

    A commanded value acts until the next one, as behind a zero-order hold. Left out are also the rows of a run before
    the first value of each of its actions. Without a column of time, all rows have to have readings.

    Args:
        values: the numbers of a log, NaN where a cell is empty, (rows, columns).
        columns: what the columns are.
        source: the file, for messages.

    Returns:
        The numbers of the rows that are left, and the indices of these rows. Empty cells of other columns stay NaN.

    Raises:
        DataError: if fewer than two rows are left.

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data import Column
        >>> from torchrl_h2o.data.readers.held_actions import hold_actions
        >>> columns = Column("t", "time", "s"), Column("q", "observation"), Column("u", "action")
        >>> log = np.array([[0.0, 0.0, np.nan], [0.1, 1.0, 5.0], [0.15, np.nan, 6.0], [0.2, 2.0, np.nan]])
        >>> hold_actions(log, columns, "log.csv")[0].tolist()
        [[0.1, 1.0, 5.0], [0.2, 2.0, 6.0]]
    """
    roles, empty = [column.role for column in columns], np.isnan(values)
    actions = np.isin(roles, ["action"])
    no_readings = empty[:, np.isin(roles, ["observation", "euler"])].all(1) & ~empty[:, actions].all(1)
    no_readings &= "time" in roles
    if not empty[:, actions].any() and not no_readings.any():
        return values, np.arange(len(values))
    known = ~empty[:, actions] | _begins(values, roles)[:, None]
    last = np.maximum.accumulate(np.where(known, np.arange(len(values))[:, None], 0), axis=0)
    values = values.copy()
    values[:, actions] = np.take_along_axis(values[:, actions], last, axis=0)
    unknown = np.isnan(values[:, actions]).any(1) & ~no_readings
    kept = np.flatnonzero(~no_readings & ~unknown)
    if len(kept) < 2:
        remedy = "correct the roles of the columns; an action without any value is none"
        raise DataError(f"{len(kept)} rows have readings and a value of each action", remedy, source=source)
    found = {
        "hold the last value of an action, because its cell is empty": empty[:, actions][kept].any(1).sum(),
        "before the first value of an action are left out": unknown.sum(),
        "without readings are left out": no_readings.sum(),
    }
    words = "; ".join(f"{count} {what}" for what, count in found.items() if count)
    torchrl_logger.warning(f"{source}: of {len(values)} rows, {words}")
    return values[kept], kept


def _begins(values: np.ndarray, roles: Sequence[str]) -> np.ndarray:
    """Whether a run begins with a row, (rows,): by its number, behind the end of another one, or as time restarts."""
    begins = np.arange(len(values)) == 0
    for index, role in enumerate(roles):
        before, after = values[:-1, index], values[1:, index]
        if role == "run":
            begins[1:] |= before != after
        elif role == "done":
            begins[1:] |= before == 1
        elif role == "time":
            begins[1:] |= after < before
    return begins
