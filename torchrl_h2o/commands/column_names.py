"""Names of a log's columns on the command line, where Hydra gives some characters a meaning and refuses others."""

from __future__ import annotations

import re
from collections.abc import Sequence

_SPECIAL = re.compile(r"([\\()\[\]{}:=,])")
_REFUSED = re.compile(r"[!\"#&';<>^`~]|[^\x20-\x7e]")


def as_key(name: str) -> str:
    """A column's name as a key of a mapping: special characters escaped, those that Hydra refuses left out.

    Examples:
        >>> print(as_key("Angle (°)"))
        Angle \\(\\)
    """
    return _SPECIAL.sub(r"\\\1", _written(name))


def column_of(key: object, names: Sequence[str]) -> str | None:
    """The column that a key of such a mapping means: the one of this name, or the only one that is written like it.

    Examples:
        >>> column_of("Angle ()", ["Angle (°)", "Speed (°/s)"])
        'Angle (°)'
        >>> column_of(2, ["1", "2"])
        '2'
    """
    written = str(key)
    alike = [name for name in names if name == written] or [name for name in names if _written(name) == written]
    return alike[0] if len(alike) == 1 else None


def _written(name: str) -> str:
    return _REFUSED.sub("", name).strip()
