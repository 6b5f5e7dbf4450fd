"""One finding of an audit, with the rows that it is about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

Severity = Literal["severe", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("severe", "warning", "note")


@dataclass(frozen=True)
class Rows:
    """Rows of the data, counted from 0: how many, and the first ranges of them.

    Args:
        count: number of rows.
        ranges: first and last row of up to some ranges, (first, last).

    Examples:
        >>> import numpy as np
        >>> str(Rows.of(np.array([3, 4, 5, 9])))
        '4 rows: 3 to 5, 9'
    """

    count: int
    ranges: tuple[tuple[int, int], ...] = ()

    @classmethod
    def of(cls, rows: np.ndarray, examples: int = 5) -> Rows:
        """Ranges of neighbouring rows.

        Args:
            rows: indices in increasing order, or a mask (T,).
            examples: largest number of ranges.
        """
        rows = np.flatnonzero(rows) if rows.dtype == bool else np.asarray(rows)
        if not len(rows):
            return cls(0)
        ends = np.append(np.flatnonzero(np.diff(rows) > 1), len(rows) - 1)
        starts = np.append(0, ends[:-1] + 1)
        ranges = [(int(rows[a]), int(rows[b])) for a, b in zip(starts, ends, strict=True)]
        return cls(len(rows), tuple(ranges[:examples]))

    def __str__(self) -> str:
        shown = ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in self.ranges)
        listed = sum(b - a + 1 for a, b in self.ranges)
        more = ", ..." if listed < self.count else ""
        return f"{self.count} row{'' if self.count == 1 else 's'}: {shown}{more}" if shown else f"{self.count} rows"


@dataclass(frozen=True)
class Finding:
    """One fault or peculiarity of measured data.

    Args:
        check: name of the check: ``"time"``, ``"rows"``, ``"kinematics"``, ``"model"``, ``"actions"`` or
            ``"excitation"``.
        severity: ``"severe"`` if a search for missing effects would give a worthless answer; ``"warning"`` if it may
            give a wrong one; ``"note"`` otherwise.
        words: what was found, with quantities and units.
        rows: the rows that show it; None for the whole data.
        remedy: what to do.

    Raises:
        ValueError: for an unknown severity.
    """

    check: str
    severity: Severity
    words: str
    rows: Rows | None = None
    remedy: str = ""

    def __post_init__(self):
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity {self.severity!r} must be one of {', '.join(SEVERITIES)}")

    def __str__(self) -> str:
        where = "" if self.rows is None or not self.rows.count else f" ({self.rows})"
        return f"{self.severity}, {self.check}: {self.words}{where}{'; ' + self.remedy if self.remedy else ''}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Finding:
        """The inverse of :meth:`to_dict`."""
        rows = plain["rows"]
        ranges = None if rows is None else Rows(rows["count"], tuple((a, b) for a, b in rows["ranges"]))
        return cls(plain["check"], plain["severity"], plain["words"], ranges, plain["remedy"])
