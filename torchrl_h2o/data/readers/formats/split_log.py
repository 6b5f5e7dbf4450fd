"""A run in several files of columns, such as one of positions and one of efforts, joined on time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_h2o.data.readers.error import DataError
from torchrl_h2o.data.readers.formats.raw_table import RawTable, require_names

if TYPE_CHECKING:
    from torchrl_h2o.data.readers.log_columns import LogColumns

_SHARED = 0.5  # share of the longest file's time that all files have in common
_FAR = 2.5  # steps from a row to that of another file beyond which this has a gap, and the row is left out
_AS_FAST = 1.5  # ratio of two files' steps up to which rows of the same moment belong together


@dataclass(frozen=True)
class SplitLog(PathLike):
    """The files of one run; as a path, it is that of the first one, whose rows are the run's.

    Args:
        files: the files by the names that their columns begin with: ``position`` for ``position.hip``.
    """

    files: Mapping[str, Path]

    def __fspath__(self) -> str:
        return str(next(iter(self.files.values())))

    def __str__(self) -> str:
        return ", ".join(f"{name}: {path}" for name, path in self.files.items())

    def __hash__(self) -> int:
        return hash(str(self))

    def rows(self, times: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Indices of the rows of each file that belong together, one for each moment at which all have begun.

        A row of the first file belongs to the nearest row of another one that is about as fast. A slower file, such as
        one of targets, holds its last row until the next.

        Args:
            times: time of each file's rows, increasing, in the same unit.

        Raises:
            DataError: for a file without two rows, time that goes back, or files that share less than half of the
                longest one's time.
        """
        for name, time in times.items():
            if len(time) < 2 or not (np.diff(time) >= 0.0).all():
                problem = "the time goes back or is missing" if len(time) > 1 else "there are fewer than two rows"
                raise DataError(problem, "files of one run are joined on time: correct it", source=self.files[name])
        (first, clock), *others = times.items()
        step = {name: float(np.median(np.diff(time))) for name, time in times.items()}
        begin, end = max(time[0] for time in times.values()), min(time[-1] + step[name] for name, time in times.items())
        moments = np.flatnonzero((clock >= begin - 0.5 * step[first]) & (clock < end))
        longest = max(time[-1] - time[0] for time in times.values())
        if len(moments) < 2 or end - begin < _SHARED * longest:
            spans = "; ".join(f"{name} from {time[0]:g} to {time[-1]:g}" for name, time in times.items())
            remedy = "give files of one run whose times have the same unit and begin, such as seconds since 1970"
            raise DataError(f"the files share less than half of their time: {spans}", remedy, source=str(self))
        clock, found, known = clock[moments], {first: moments}, np.ones(len(moments), bool)
        for name, time in others:
            after = np.searchsorted(time, clock, side="right").clip(1, len(time) - 1)
            is_nearer = np.abs(time[after] - clock) < np.abs(clock - time[after - 1])
            is_fast = step[name] < _AS_FAST * step[first]
            row = after - 1 + (is_nearer if is_fast else time[after] <= clock)
            known &= np.abs(time[row] - clock) < _FAR * max(step[name], step[first])
            found[name] = row
        return {name: rows[known] for name, rows in found.items()}


def read_split(log: SplitLog, layout: LogColumns, read: Callable[[Path, LogColumns], RawTable]) -> RawTable:
    """Read the columns of all files, ``position.hip`` for ``hip`` of the file ``position``.

    Args:
        log: the files.
        layout: the columns, with the time of the first file; the others have a column of the same name.
        read: reads a file.

    Raises:
        DataError: for a column of time that is missing, or is not that of the first file; see also
            :meth:`SplitLog.rows`.
    """
    first = next(iter(log.files))
    time = layout.named("time")
    if time is None or not time.name.startswith(f"{first}."):
        problem = f"files of one run are joined on time, and no column {first}... has the role time"
        raise DataError(problem, "describe the time of the first file", source=str(log))
    clock = time.name.removeprefix(f"{first}.")
    parts = {name: read(path, _layout_of(name, clock, layout)) for name, path in log.files.items()}
    columns = {name: part.names or () for name, part in parts.items()}
    times = {name: part.numbers([columns[name].index(clock)], [clock])[:, 0] for name, part in parts.items()}
    rows = log.rows(times)
    names = tuple(f"{name}.{column}" for name, own in columns.items() for column in own)
    places = [(name, index) for name, own in columns.items() for index in range(len(own))]

    def numbers(indices: Sequence[int], called: Sequence[str]) -> np.ndarray:
        found = np.empty((len(rows[first]), len(indices)))
        for place, (index, column) in enumerate(zip(indices, called, strict=True)):
            name, own = places[index]
            found[:, place] = parts[name].numbers([own], [column])[rows[name], 0]
        return found

    require_names(names, layout, log)
    return RawTable(log, names, len(names), parts[first].rows[rows[first]], numbers)


def _layout_of(name: str, clock: str, layout: LogColumns) -> LogColumns:
    """The described columns of one file, for its reader, which looks at names and at how the file is written."""
    own = [one.name.removeprefix(f"{name}.") for one in layout.in_file if one.name.startswith(f"{name}.")]
    columns = tuple(type(layout.columns[0])(column, "observation") for column in dict.fromkeys([clock, *own]))
    return replace(
        layout,
        columns=columns,
        dt=1.0,
        header=True,
        other_columns="ignore",
        observation=(),
        action=(),
        free_motion=True,
        resample=None,
    )
