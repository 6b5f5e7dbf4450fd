"""Guess which columns hold the place, orientation and velocities of a body that moves freely, such as a drone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.guess.roles import Guess, words_of
from torchrl_h2o.data.readers.units import to_si

PLACE, ORIENTATION, VELOCITY, RATE = "position", "orientation", "velocity", "angular velocity"
_AXES = {PLACE: "xyz", ORIENTATION: "wxyz", VELOCITY: "xyz", RATE: "xyz"}
_UNITS = {PLACE: "m", ORIENTATION: "1", VELOCITY: "m/s", RATE: "rad/s"}
_LETTERS = {"p": PLACE, "q": ORIENTATION, "v": VELOCITY, "w": RATE}  # px, qw, vx, wx
_KINDS = {  # words beside an axis; the first kind that fits
    RATE: ("gyro", "omega", "angular", "angvel", "rate", "rates", "w"),
    ORIENTATION: ("quat", "quaternion", "orientation", "rotation", "rot", "attitude", "q"),
    VELOCITY: ("vel", "velocity", "linear", "linvel", "dot", "speed", "v"),
    PLACE: ("pos", "position", "pose", "p", "translation"),
}
_TURNS = {"x": "roll", "y": "pitch", "z": "yaw"}  # as the model's angular velocities are named
_NOTES = {
    VELOCITY: "expected in the axes of the world, not of the body",
    RATE: "expected in the axes of the body, as a gyroscope measures it",
}


@dataclass(frozen=True)
class FreeBody:
    """The columns of a free body.

    Args:
        columns: all columns of the log, those of the body with their kind, unit and what to check.
        coordinates: the model's coordinate of each column of the body.
    """

    columns: list[Guess]
    coordinates: Mapping[str, str]


def free_body(
    columns: Sequence[Guess], values: Mapping[str, np.ndarray | None], coordinates: Sequence[str]
) -> FreeBody:
    """Find the columns of a model's free joint by their names, if it has one such joint and the log its quaternion.

    Args:
        columns: what each column may be.
        values: the numbers of each column by name.
        coordinates: names of the model's coordinates.

    Example:
        >>> import numpy as np
        >>> from torchrl_h2o.data.readers.guess.free_body import free_body
        >>> from torchrl_h2o.data.readers.guess.roles import guess_columns
        >>> log = {name: np.zeros(3) for name in ("x", "y", "z", "qw", "qx", "qy", "qz", "gyro_x", "gyro_y", "gyro_z")}
        >>> log["qw"] = np.ones(3)
        >>> joint = [f"root_{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz", "roll_velocity")]
        >>> found = free_body(guess_columns(log), log, joint).coordinates
        >>> found["qx"], found["gyro_x"]
        ('root_qx', 'root_roll_velocity')
    """
    joints = [name.removesuffix("_qw") for name in coordinates if name.endswith("_qw")]
    joints = [joint for joint in joints if f"{joint}_x" in coordinates]  # a ball joint has no place
    groups = _groups(columns, values) if len(joints) == 1 else {}
    if ORIENTATION not in groups:
        return FreeBody(list(columns), {})
    found = {
        name: (kind, axis, _coordinate(joints[0], kind, axis))
        for kind, names in groups.items()
        for axis, name in names.items()
    }
    return FreeBody(
        [_of_body(column, *found[column.name][:2]) if column.name in found else column for column in columns],
        {name: coordinate for name, (_, _, coordinate) in found.items()},
    )


def _groups(columns: Sequence[Guess], values: Mapping[str, np.ndarray | None]) -> dict[str, dict[str, str]]:
    """The columns of each kind by axis, of the kinds that have one column for each axis."""
    found: dict[str, dict[str, str]] = {kind: {} for kind in _AXES}
    for column in columns:
        kind, axis = _kind_and_axis(column)
        if kind is not None and values.get(column.name) is not None:
            found[kind].setdefault(axis, column.name)
    whole = {kind: names for kind, names in found.items() if set(names) == set(_AXES[kind])}
    if ORIENTATION in whole:
        quaternion = np.stack([np.asarray(values[name]) for name in whole[ORIENTATION].values()])
        if np.nanmedian(np.abs((quaternion**2).sum(0) - 1.0)) > 0.1:
            del whole[ORIENTATION]
    return whole


def _kind_and_axis(column: Guess) -> tuple[str | None, str]:
    """The kind and axis of a column's name, such as ``vx``, ``gyro_x`` or ``pose.orientation.w``; None for others."""
    words = words_of(column.name)
    if column.kind.startswith("desired") or not words:
        return None, ""
    (axis, *letter), rest = reversed(words[-1]), set(words[:-1])
    if words[-1] == "dot" and len(words) > 1:  # x_dot
        axis, letter, rest = words[-2][-1], list(words[-2][:-1]), {"dot", *words[:-2]}
    if len(letter) > 1 or axis not in "wxyz" or (letter and letter[0] not in _LETTERS):
        return None, ""
    kinds = [kind for kind, known in _KINDS.items() if not rest.isdisjoint(known)]
    kind = _LETTERS[letter[0]] if letter else next(iter(kinds), None if rest else PLACE)
    return (kind, axis) if kind is not None and axis in _AXES[kind] else (None, "")


def _coordinate(joint: str, kind: str, axis: str) -> str:
    if kind == ORIENTATION:
        return f"{joint}_q{axis}"
    return {PLACE: f"{joint}_{axis}", VELOCITY: f"{joint}_{axis}_velocity"}.get(
        kind, f"{joint}_{_TURNS[axis]}_velocity"
    )


def _of_body(column: Guess, kind: str, axis: str) -> Guess:
    unit = column.unit if to_si(column.unit)[0] == _UNITS[kind] else _UNITS[kind]
    stem = f"free body {axis}" if kind in (PLACE, VELOCITY) else ""
    return replace(column, kind=kind, unit=unit, stem=stem, note=_NOTES.get(kind, ""))
