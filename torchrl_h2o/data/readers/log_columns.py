"""The layout of a robot log: names, roles and units of its columns, and timing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from torchrl_h2o.data.readers.units import to_si

EULER = ("roll", "pitch", "yaw")
_MOST_JUMPS = 0.3  # share of rows that may differ from the row before by more than half a turn of the angle
Role = Literal["observation", "action", "reward", "done", "time", "run", "euler", "ignore"]


@dataclass(frozen=True)
class Column:
    """One column of a log.

    Args:
        name: the column's name; in a file with a header, the name in the header.
        role: one of observation, action, reward, done, time, run, euler, ignore. ``done`` is 1 in rows in which the
            task has ended. The ``reward`` of a row is the reward of that row's action. ``run`` is the number of an
            episode: a run ends where it changes. Of the role ``euler`` are roll, pitch and yaw of a free body, which
            become its quaternion.
        unit: the unit in the file, which is converted to SI; see :data:`~torchrl_h2o.data.readers.units.UNITS`.
        scale: a factor in addition to the unit's, such as a gear ratio or a sign.
        offset: a constant in SI that is added after unit and scale, such as the zero of an angle.
        unwrap: for an angle that jumps by a turn at the end of its range, ``True``, or the size of a turn in the file,
            such as 4096 for an encoder's counts; its turns are then counted from the first row on. ``True`` takes the
            angle before ``scale``, such as a gear ratio, to have a turn of 2π.
        bounds: lowest and highest value in SI, for actions only.
        index: position in the file, counted from 0, for files without names; all columns have it, or none.
        derivative_of: the observed position whose velocity this column is, for a velocity that is not in the file. It
            is estimated, in SI; see :func:`~torchrl_h2o.data.readers.velocity.estimate_velocity`.
        coordinate: the coordinate of the model that an observation measures, if it has another name than the column;
            for the role ``euler``, ``root_roll``, ``root_pitch`` or ``root_yaw`` for the free joint ``root``.
        is_quaternion: whether it is a number of a quaternion that is computed from three columns with the role
            ``euler``; :class:`LogColumns` adds these.

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data import Column
        >>> Column("pitch", "observation", unit="deg").factor
        0.017453292519943295
        >>> pole = Column("pole", "observation", unit="deg", offset=3.1416, unwrap=True)  # hangs at 0 in the model
        >>> pole.in_si(np.array([140.0, 150.0, 160.0, 170.0, 180.0, -170.0])).round(2).tolist()
        [5.59, 5.76, 5.93, 6.11, 6.28, 6.46]
    """

    name: str
    role: Role
    unit: str = "1"
    scale: float = 1.0
    offset: float = 0.0
    unwrap: bool | float = False
    bounds: tuple[float, float] | None = None
    index: int | None = None
    derivative_of: str | None = None
    coordinate: str | None = None
    is_quaternion: bool = False

    def __post_init__(self):
        if not isinstance(self.name, str):
            raise ValueError(f"name {self.name!r} is not a string: quote it (YAML reads on, off, yes, no as booleans)")
        if self.role not in get_args(Role):
            raise ValueError(f"unknown role {self.role!r}; choose from {', '.join(get_args(Role))}")
        try:
            si_unit, _ = to_si(self.unit)
        except KeyError as error:
            raise ValueError(error.args[0]) from None
        if self.role == "time" and si_unit != "s":
            raise ValueError(f"the unit {self.unit!r} is not a unit of time; use s, ms or us")
        if not math.isfinite(self.scale) or self.scale == 0:
            raise ValueError(f"scale {self.scale} must be finite and not zero")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset {self.offset} must be finite")
        if not isinstance(self.unwrap, bool) and not (
            isinstance(self.unwrap, int | float) and 0 < self.unwrap < math.inf
        ):
            raise ValueError(f"unwrap {self.unwrap!r} must be true, false, or the size of a turn in the file")
        if self.role == "euler" and (si_unit != "rad" or (self.coordinate or "").rpartition("_")[2] not in EULER):
            raise ValueError(
                "an Euler angle needs its unit, rad or deg, and coordinate: root_roll, root_pitch or root_yaw"
            )
        if self.unwrap and (si_unit != "rad" or self.role not in ("observation", "action")):
            raise ValueError("unwrap is for observed or commanded angles: give the unit, rad or deg")
        if self.bounds is not None:
            if self.role != "action":
                raise ValueError("bounds are for actions only")
            if not self.bounds[0] < self.bounds[1]:
                raise ValueError(f"bounds {list(self.bounds)} must be [lowest, highest]")
        if self.index is not None and (
            not isinstance(self.index, int) or isinstance(self.index, bool) or self.index < 0
        ):
            raise ValueError(f"index {self.index!r} must be a number of a column, counted from 0")
        if self.derivative_of is not None and self.role != "observation":
            raise ValueError("derivative_of is for observations only")
        if self.coordinate is not None and self.role not in ("observation", "euler"):
            raise ValueError("coordinate is for observations only")
        is_plain = (self.index, self.unwrap, self.unit, self.scale, self.offset) == (None, False, "1", 1.0, 0.0)
        if self.derivative_of is not None and not is_plain:
            raise ValueError("a column with derivative_of is not in the file: omit index, unit, scale, offset, unwrap")

    @property
    def factor(self) -> float:
        """The factor from the file's value to SI."""
        return to_si(self.unit)[1] * self.scale

    def in_si(self, values: np.ndarray) -> np.ndarray:
        """Values of the file (rows,) in SI, with ``offset``; for ``unwrap``, without jumps by a turn.

        Raises:
            ValueError: if the values cannot be an angle with such a turn.
        """
        values = values * self.factor
        if self.unwrap:
            turn = 2.0 * math.pi * abs(self.scale) if self.unwrap is True else self.unwrap * abs(self.factor)
            if (np.abs(np.diff(values)) > 0.5 * turn).mean() > _MOST_JUMPS:
                size = f"half a turn of {turn / abs(self.factor):.4g} in the file"
                remedy = "give the size of its turn, such as unwrap: 4096, or correct unit and scale"
                raise ValueError(f"{self.name}: many rows differ by more than {size}; {remedy}")
            values = np.unwrap(values, period=turn)
        return values + self.offset


@dataclass(frozen=True)
class LogColumns:
    """The layout of a log file. Options that drop rows are off by default.

    Files of .parquet, .npz, .mat and .mcap name their columns, and have no separator, header, comment and decimal.

    Args:
        columns: the columns; for a file without a header, in the file's order, or with their ``index``.
        dt: time between two rows in s; ``None`` uses the median of the time column.
        separator: ``"whitespace"`` or one character; with a character, cells may be quoted with "".
        header: whether the first row holds the names.
        comment: a character; lines that begin with it are skipped, including lines before the header.
        decimal: the decimal separator, ``"."`` or ``","``.
        other_columns: treatment of columns in the header that are not described: ``"error"`` or ``"ignore"``.
        observation: names in the order of the observation vector; the file's order by default.
        action: names in the order of the action vector; the file's order by default.
        outside_bounds: treatment of actions outside their bounds: ``"error"`` or ``"clip"``.
        time_tolerance: largest deviation of a time step from dt, as a share of dt.
        on_time_jump: treatment of larger deviations: ``"error"``, or ``"split"``, which starts a new run there, also
            where time begins again. Rows out of order are always an error.
        after_done: treatment of rows with done = 0 after a row with done = 1: ``"error"``, ``"drop"``, which drops the
            rest of the file, or ``"new_episode"``.
        drop_trailing_zero_rows: whether to drop rows at the end of the file that are all zero.
        free_motion: whether the log has no actions; those of the transitions then have the shape (T, 0).
        topic: for a bag with several topics of joint states, the one whose messages are the rows.
        resample: step in s of a regular clock for a log whose time stamps are irregular; see
            :func:`~torchrl_h2o.data.readers.resample.resample`. Steps in time longer than it, or than the median step
            if that is longer, by more than ``time_tolerance`` are jumps.

    Raises:
        ValueError: for contradicting or invalid entries; the message lists what is allowed.

    Example:
        >>> from torchrl_h2o.data import Column, LogColumns
        >>> log = LogColumns((Column("v", "observation"), Column("tau", "action")), dt=0.005)
        >>> log.observation
        ('v',)
    """

    columns: tuple[Column, ...]
    dt: float | None = None
    separator: str = "whitespace"
    header: bool = False
    comment: str | None = None
    decimal: Literal[".", ","] = "."
    other_columns: Literal["error", "ignore"] = "error"
    observation: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    outside_bounds: Literal["error", "clip"] = "error"
    time_tolerance: float = 0.5
    on_time_jump: Literal["error", "split"] = "error"
    after_done: Literal["error", "drop", "new_episode"] = "error"
    drop_trailing_zero_rows: bool = False
    free_motion: bool = False
    topic: str | None = None
    resample: float | None = None

    def __post_init__(self):
        for name, count in Counter(column.name for column in self.columns).items():
            if count > 1:
                raise ValueError(f"the column name {name!r} occurs {count} times")
        self._add_quaternion()
        for role in ("observation", "action"):
            names = self._names(role)
            if not names and not (role == "action" and self.free_motion):
                free = "; set free_motion: true if the log has no actions" if role == "action" else ""
                raise ValueError(f"there is no column with the role {role!r}{free}")
            order = getattr(self, role) or names
            if sorted(order) != sorted(names):
                raise ValueError(f"{role}: {list(order)} must name each of {list(names)} once")
            object.__setattr__(self, role, tuple(order))
        if self.free_motion and self.action:
            raise ValueError(f"free_motion: true, but {', '.join(self.action)} has the role action")
        self._check_places()
        for role in ("reward", "done", "time", "run"):
            if len(self._names(role)) > 1:
                raise ValueError(f"several columns have the role {role!r}; at most one is allowed")
        if self.dt is None and not self._names("time"):
            raise ValueError("dt is missing, and there is no time column to derive it from")
        if self.dt is not None and not 0 < self.dt < math.inf:
            raise ValueError(f"dt {self.dt} must be a positive number of seconds")
        if self.resample is not None:
            self._check_resample(self.resample)
        if not isinstance(self.separator, str) or (self.separator != "whitespace" and len(self.separator) != 1):
            raise ValueError(f"separator {self.separator!r} must be 'whitespace' or one character")
        if self.separator in ('"', "\n", "\r"):
            raise ValueError(f"separator {self.separator!r} cannot separate cells; choose another")
        if self.comment is not None and not (isinstance(self.comment, str) and len(self.comment.strip()) == 1):
            raise ValueError(
                f"comment {self.comment!r} must be one character (quoted, because # starts a comment in YAML)"
            )
        if self.decimal == self.separator:
            raise ValueError(f"decimal and separator are both {self.decimal!r}; they must differ")
        if self.other_columns == "ignore" and not self.header and not self.by_index:
            raise ValueError(
                "other_columns: ignore requires a header; without one, describe all columns, with role: ignore"
            )
        if not 0 < self.time_tolerance < math.inf:
            raise ValueError(f"time_tolerance {self.time_tolerance} must be positive")
        for name, kind in get_type_hints(type(self)).items():
            allowed = (True, False) if kind is bool else get_args(kind) if get_origin(kind) is Literal else None
            if allowed is not None and getattr(self, name) not in allowed:
                raise ValueError(f"{name} {getattr(self, name)!r} must be one of {allowed}")

    def _check_resample(self, step: float) -> None:
        if not 0 < step < math.inf:
            raise ValueError(f"resample {step} must be a positive number of seconds")
        if self.dt is not None or not self._names("time"):
            raise ValueError("resample needs a time column and replaces dt; give one of resample and dt")
        if self._names("reward"):
            raise ValueError("rewards belong to the steps of the file; with resample, set their role to ignore")

    def _check_places(self) -> None:
        indices = [column.index for column in self.in_file]
        if not indices:
            raise ValueError("all columns have derivative_of; describe those of the file")
        if set(indices) != {None} and (None in indices or len(set(indices)) < len(indices)):
            raise ValueError("two columns have the same index, or only some have one; give all or none an index")
        positions = [name for name in self._names("observation") if name not in self.derivatives]
        for name, position in self.derivatives.items():
            if position not in positions:
                raise ValueError(f"{name}: derivative_of {position!r} must be one of the observations {positions}")

    def _add_quaternion(self) -> None:
        """Adds the quaternion of a free joint whose Euler angles the log has."""
        angles = [column.coordinate or "" for column in self.columns if column.role == "euler"]
        joints = {coordinate.rpartition("_")[0] for coordinate in angles}
        if angles and sorted(angles) != sorted(f"{min(joints)}_{name}" for name in EULER):
            raise ValueError(f"three columns have the role euler, one for each of {', '.join(EULER)} of the same joint")
        known = {column.name for column in self.columns}
        names = [f"{joint}_q{axis}" for joint in joints for axis in "wxyz"]
        added = tuple(Column(name, "observation", is_quaternion=True) for name in names if name not in known)
        object.__setattr__(self, "columns", self.columns + added)

    @property
    def euler(self) -> tuple[str, ...]:
        """The columns of roll, pitch and yaw; empty if there are none."""
        own = {
            (column.coordinate or "").rpartition("_")[2]: column.name
            for column in self.columns
            if column.role == "euler"
        }
        return tuple(own[name] for name in EULER) if own else ()

    @property
    def in_file(self) -> tuple[Column, ...]:
        """The columns that are in the file: all but estimated velocities and computed quaternions."""
        return tuple(one for one in self.columns if one.derivative_of is None and not one.is_quaternion)

    @property
    def by_index(self) -> bool:
        """Whether the columns are given by their positions in the file."""
        return self.in_file[0].index is not None

    @property
    def derivatives(self) -> dict[str, str]:
        """The estimated velocities and the position of each."""
        return {column.name: column.derivative_of for column in self.columns if column.derivative_of is not None}

    @property
    def coordinates(self) -> dict[str, str]:
        """The coordinate of the model that each observed column measures, in the order of the observation."""
        of_column = {column.name: column.coordinate or column.name for column in self.columns}
        return {name: of_column[name] for name in self.observation}

    def named(self, role: str) -> Column | None:
        """Return the column of a role that occurs at most once, or None."""
        return next((column for column in self.columns if column.role == role), None)

    def _names(self, role: str) -> tuple[str, ...]:
        return tuple(column.name for column in self.columns if column.role == role)

    @classmethod
    def load(cls, source: str | Path | Mapping[str, Any]) -> LogColumns:
        """Read a layout from a YAML file or from its entries, or a layout of the package by its name.

        Args:
            source: a path, a mapping such as ``{"dt": 0.01, "columns": [{"name": "q", "role": "observation"}, ...]}``,
                or ``"wheel_legged_standing_still"``, ``"wheel_legged_moving_forward"``,
                ``"simple_pendulum"`` or ``"double_pendulum"``.

        Raises:
            DataError: a missing file, invalid YAML, an unknown, duplicate or invalid entry, or contradicting entries.

        Example:
            >>> from torchrl_h2o.data import LogColumns
            >>> LogColumns.load("wheel_legged_standing_still").observation
            ('theta', 'theta_dot', 'x', 'v')
        """
        # imported here, because it imports this file, and a layout written in code does not need yaml
        from torchrl_h2o.data.readers.columns_file import read_layout

        return read_layout(source)
