"""What the columns of a robot log mean: names, roles, units and timing, read from a small YAML."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from torchrl_h2o.data.error import DataError
from torchrl_h2o.data.units import to_si

ROLES = ("observation", "action", "reward", "done", "time", "ignore")


@dataclass(frozen=True)
class Column:
    """One column of a log.

    Args:
        name: its name; with a header, the one that stands there.
        role: one of observation, action, reward, done, time, ignore. ``done`` is 1 in the rows in
            which the task has ended. ``reward`` in a row is what that row's action earned.
        unit: the unit of the file, turned into SI; see :data:`~torchrl_h2o.data.units.UNITS`.
        scale: a factor beside the unit (a gear ratio, a sign).
        bounds: lowest and highest value in SI, for actions.

    Example:
        >>> from torchrl_h2o.data import Column
        >>> Column("pitch", "observation", unit="deg").factor
        0.017453292519943295
    """

    name: str
    role: Literal["observation", "action", "reward", "done", "time", "ignore"]
    unit: str = "1"
    scale: float = 1.0
    bounds: tuple[float, float] | None = None

    def __post_init__(self):
        if self.role not in ROLES:
            raise ValueError(f"unknown role {self.role!r}; known are {', '.join(ROLES)}")
        try:
            si_unit, _ = to_si(self.unit)
        except KeyError as error:
            raise ValueError(error.args[0]) from None
        if self.role == "time" and si_unit != "s":
            raise ValueError(f"the unit {self.unit!r} is none of time; take s, ms or us")
        if not math.isfinite(self.scale) or self.scale == 0:
            raise ValueError(f"scale {self.scale} must be finite and not zero")
        if self.bounds is not None:
            if self.role != "action":
                raise ValueError("bounds are for actions only")
            if not self.bounds[0] < self.bounds[1]:
                raise ValueError(f"bounds {list(self.bounds)} must be [lowest, highest]")

    @property
    def factor(self) -> float:
        """What the file's value is multiplied by to have it in SI."""
        return to_si(self.unit)[1] * self.scale


@dataclass(frozen=True)
class LogColumns:
    """The layout of a log file. Whatever leaves rows out has to be asked for by name.

    Args:
        columns: the columns; without a header in the file's order.
        dt: seconds between two rows; ``None`` takes the median of the time column.
        separator: ``"whitespace"`` or one character.
        header: whether the first row holds the names.
        observation: names in the order of the observation vector; the file's order by default.
        action: the same for the action vector.
        outside_bounds: an action outside its bounds is an ``"error"``, or ``"clip"`` it.
        time_tolerance: how far a time step may be from dt, as a share of dt.
        on_time_jump: a time step outside of that is an ``"error"``, or ``"split"`` the run there.
            Time that runs backwards is always an error.
        after_done: rows with done = 0 behind a row with done = 1 are an ``"error"``; or ``"drop"``
            the rest of the file, or begin a ``"new_episode"`` with them.
        drop_trailing_zero_rows: leave out rows at the end of the file that are zero throughout.

    Raises:
        ValueError: a contradiction, with what is allowed.

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
    observation: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    outside_bounds: Literal["error", "clip"] = "error"
    time_tolerance: float = 0.5
    on_time_jump: Literal["error", "split"] = "error"
    after_done: Literal["error", "drop", "new_episode"] = "error"
    drop_trailing_zero_rows: bool = False

    def __post_init__(self):
        for name, count in Counter(column.name for column in self.columns).items():
            if count > 1:
                raise ValueError(f"the column name {name!r} stands there {count} times")
        for role in ("observation", "action"):
            names = self._names(role)
            if not names:
                raise ValueError(f"there is no column with the role {role!r}")
            order = getattr(self, role) or names
            if sorted(order) != sorted(names):
                raise ValueError(f"{role}: {list(order)} must name each of {list(names)} once")
            object.__setattr__(self, role, tuple(order))
        for role in ("reward", "done", "time"):
            if len(self._names(role)) > 1:
                raise ValueError(f"several columns have the role {role!r}; one can")
        if self.dt is None and not self._names("time"):
            raise ValueError("dt is missing, and so is a time column to take it from")
        if self.dt is not None and not 0 < self.dt < math.inf:
            raise ValueError(f"dt {self.dt} must be a positive number of seconds")
        if self.separator != "whitespace" and len(self.separator) != 1:
            raise ValueError(f"separator {self.separator!r} must be 'whitespace' or one character")
        if self.time_tolerance <= 0:
            raise ValueError(f"time_tolerance {self.time_tolerance} must be positive")
        for name, allowed in (
            ("outside_bounds", ("error", "clip")),
            ("on_time_jump", ("error", "split")),
            ("after_done", ("error", "drop", "new_episode")),
            ("header", (True, False)),
            ("drop_trailing_zero_rows", (True, False)),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} {getattr(self, name)!r} must be one of {allowed}")

    def named(self, role: str) -> Column | None:
        """The column with a role of which there is at most one."""
        return next((column for column in self.columns if column.role == role), None)

    def _names(self, role: str) -> tuple[str, ...]:
        return tuple(column.name for column in self.columns if column.role == role)

    @classmethod
    def load(cls, source: str | Path) -> LogColumns:
        """Read the layout from a YAML file, or one that comes with the package by its name.

        Args:
            source: a path, or ``"wheel_legged_standing_still"``, ``"wheel_legged_moving_forward"``
                or ``"simple_pendulum"``.

        Raises:
            DataError: no such file, no YAML, an unknown entry, a contradiction.

        Example:
            >>> from torchrl_h2o.data import LogColumns
            >>> LogColumns.load("wheel_legged_standing_still").observation
            ('theta', 'theta_dot', 'x', 'v')
        """
        import yaml

        path = _find(source)
        try:
            entries = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise DataError(f"no YAML: {error}", "correct it", source=source) from error
        known = _known_entries(cls, entries, source)
        if not isinstance(known.get("columns"), list) or not known["columns"]:
            raise DataError("'columns' is no list", "list the file's columns", source=source)
        columns = tuple(
            _build(
                Column,
                {"name": f"column {number}", **_known_entries(Column, entry, source)},
                source,
            )
            for number, entry in enumerate(known["columns"], start=1)
        )
        return _build(cls, {**known, "columns": columns}, source)


def _find(source: str | Path) -> Path:
    path = Path(source).expanduser()
    if path.is_file():
        return path
    shipped = Path(str(resources.files("torchrl_h2o.data") / "logs"))
    names = sorted(file.stem for file in shipped.glob("*.yaml"))
    if str(source) in names:
        return shipped / f"{source}.yaml"
    raise DataError(
        "there is no such column description",
        f"give a YAML file or one of {', '.join(names)}",
        source=source,
    )


def _known_entries(kind: type, entries: Any, source: str | Path) -> dict[str, Any]:
    known = [field.name for field in fields(kind)]
    if not isinstance(entries, dict):
        raise DataError(f"{entries!r} is no mapping", f"give {', '.join(known)}", source=source)
    for name in entries:
        if name not in known:
            raise DataError(f"unknown entry {name!r}", f"known are {', '.join(known)}", source=source)
    return entries


def _build(kind: type, entries: dict[str, Any], source: str | Path) -> Any:
    numbers = {"dt", "scale", "time_tolerance"}
    lists = {"bounds", "observation", "action"}
    column = str(entries["name"]) if kind is Column else None
    try:
        # YAML 1.1 takes 5e-3 for a text
        values = {
            name: float(value) if name in numbers and value is not None else value for name, value in entries.items()
        }
        for name in lists & values.keys():
            values[name] = tuple(values[name])
        if "bounds" in values:
            low, high = values["bounds"]
            values["bounds"] = (float(low), float(high))
        return kind(**values)
    except (ValueError, TypeError) as error:
        raise DataError(str(error), "correct the column description", source=source, column=column) from error
