"""Guess which columns hold the place, orientation and velocities of a body that moves freely, such as a drone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.guess.roles import Guess, without_unit, words_of
from torchrl_h2o.data.readers.units import to_si

PLACE, ORIENTATION, VELOCITY, RATE = "position", "orientation", "velocity", "angular velocity"
EULER = "euler"
_AXES = {PLACE: "xyz", ORIENTATION: "wxyz", VELOCITY: "xyz", RATE: "xyz"}
_UNITS = {PLACE: "m", ORIENTATION: "1", VELOCITY: "m/s", RATE: "rad/s"}
_LETTERS = {"p": PLACE, "q": ORIENTATION, "v": VELOCITY, "w": RATE}  # px, qw, vx, wx
_KINDS = {  # words beside an axis; the first kind that fits
    RATE: ("gyro", "omega", "angular", "angvel", "rate", "rates", "w"),
    ORIENTATION: ("quat", "quaternion", "orientation", "rotation", "rot", "attitude", "q"),
    VELOCITY: ("vel", "velocity", "linear", "linvel", "dot", "speed", "v"),
    PLACE: ("pos", "position", "pose", "p", "translation"),
}
_NO_STATE = (  # a column with such a word is no state of the body
    *("acc", "accel", "acceleration", "cmd", "command", "commanded", "des", "desired", "ref", "reference"),
    *("target", "goal", "setpoint", "sp", "err", "error", "bias", "offset", "std", "cov", "var", "foot", "feet"),
    *("wind", "force", "torque"),
)
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
    """Find the columns of a model's free joint by their names, if it has one such joint and the log its orientation.

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
    if len(joints) == 1 and ORIENTATION not in groups:
        groups |= _euler(columns)
    if ORIENTATION not in groups and EULER not in groups:
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
    """The columns of each kind by axis, of the kinds that have one column for each axis, with one beginning.

    Of several such groups, the one with the shortest beginning is taken: ``pos_x`` rather than ``second_pos_x``.
    """
    found: dict[str, dict[tuple[str, ...], dict[str, str]]] = {kind: {} for kind in _AXES}
    for column in columns:
        kind, axis, beginning = _kind_and_axis(column)
        if kind is not None and values.get(column.name) is not None:
            found[kind].setdefault(beginning, {}).setdefault(axis, column.name)
    whole = {
        kind: [
            names
            for _, names in sorted(groups.items(), key=lambda group: len(group[0]))
            if set(names) == set(_AXES[kind])
        ]
        for kind, groups in found.items()
    }
    whole[ORIENTATION] = [
        names for names in whole[ORIENTATION] if _is_quaternion([values[name] for name in names.values()])
    ]
    return {kind: groups[0] for kind, groups in whole.items() if groups}


def _euler(columns: Sequence[Guess]) -> dict[str, dict[str, str]]:
    """The columns of roll, pitch and yaw by these names, of one beginning."""
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for column in columns:
        words = words_of(without_unit(column.name)[0])
        if words and words[-1] in _TURNS.values() and column.kind == "position" and not set(words) & set(_NO_STATE):
            found.setdefault(tuple(words[:-1]), {}).setdefault(words[-1], column.name)
    whole = [names for _, names in sorted(found.items(), key=lambda one: len(one[0])) if len(names) == len(_TURNS)]
    return {EULER: whole[0]} if whole else {}


def _is_quaternion(numbers: Sequence[np.ndarray | None]) -> bool:
    quaternion = np.stack([np.asarray(each) for each in numbers])
    return bool(np.nanmedian(np.abs((quaternion**2).sum(0) - 1.0)) <= 0.1)


def _kind_and_axis(column: Guess) -> tuple[str | None, str, tuple[str, ...]]:
    """The kind and axis of a name such as ``vx``, ``gyro_x`` or ``pose.orientation.w``, and its other words.

    The kind is None for names of something else.
    """
    words = words_of(without_unit(column.name)[0])
    nothing = None, "", ()
    if column.kind == "action" or column.kind.startswith("desired") or not words or set(words) & set(_NO_STATE):
        return nothing
    (axis, *letter), rest = reversed(words[-1]), words[:-1]
    if words[-1] == "dot" and len(words) > 1:  # x_dot
        axis, letter, rest = words[-2][-1], list(words[-2][:-1]), ["dot", *words[:-2]]
    if len(letter) > 1 or axis not in "wxyz" or (letter and letter[0] not in _LETTERS):
        return nothing
    kinds = [kind for kind, known in _KINDS.items() if not set(rest).isdisjoint(known)]
    kind = _LETTERS[letter[0]] if letter else next(iter(kinds), None if rest else PLACE)
    other = tuple(word for word in rest if not any(word in known for known in _KINDS.values()))
    return (kind, axis, other) if kind is not None and axis in _AXES[kind] else nothing


def _coordinate(joint: str, kind: str, axis: str) -> str:
    if kind in (ORIENTATION, EULER):
        return f"{joint}_q{axis}" if kind == ORIENTATION else f"{joint}_{axis}"
    return {PLACE: f"{joint}_{axis}", VELOCITY: f"{joint}_{axis}_velocity"}.get(
        kind, f"{joint}_{_TURNS[axis]}_velocity"
    )


def _of_body(column: Guess, kind: str, axis: str) -> Guess:
    if kind == EULER:
        return replace(column, kind=kind, note=f"turns about z, then y, then x: check the order; {column.note}")
    unit = column.unit if to_si(column.unit)[0] == _UNITS[kind] else _UNITS[kind]
    stem = f"free body {axis}" if kind in (PLACE, VELOCITY) else ""
    note = "; ".join(filter(None, [_NOTES.get(kind, ""), column.note if kind != ORIENTATION else ""]))
    return replace(column, kind=kind, unit=unit, stem=stem, note=note)


def velocities_together(columns: Sequence[Guess], coordinates: Mapping[str, str]) -> list[Guess]:
    """All three velocities of the body as columns to ignore, if one of them does not follow its position.

    They may be in the body's axes, as those of a robot's odometry.

    Args:
        columns: the columns, among them velocities that were found not to be slopes.
        coordinates: the model's coordinate of each column of the body.
    """
    moves = [
        name for name, other in coordinates.items() if other.endswith(("_x_velocity", "_y_velocity", "_z_velocity"))
    ]
    if all(column.kind == VELOCITY for column in columns if column.name in moves):
        return list(columns)
    note = "not the slope of its position: perhaps in the axes of the body; it is estimated instead"
    return [replace(column, kind="unknown", note=note) if column.name in moves else column for column in columns]
