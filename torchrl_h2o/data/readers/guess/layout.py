"""Guess what the columns of a log are, from their names, their slopes and the user's model."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from os import PathLike

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents, read_contents
from torchrl_h2o.data.readers.guess.coordinates import (
    Coordinates,
    coordinates_of,
    without_constants,
    without_missing_joints,
)
from torchrl_h2o.data.readers.guess.free_body import FreeBody, free_body, velocities_together
from torchrl_h2o.data.readers.guess.layout_text import layout_text
from torchrl_h2o.data.readers.guess.normalised import scaled
from torchrl_h2o.data.readers.guess.roles import (
    PERHAPS,
    Guess,
    guess_columns,
    is_force,
    kind_of_joint,
    may_be_command,
    slope_of,
    without_unit,
    words_of,
)
from torchrl_h2o.data.readers.guess.slopes import Slopes, slopes_among, time_of
from torchrl_h2o.data.readers.guess.unnamed import recognise
from torchrl_h2o.data.readers.units import to_si

_SURPLUS = "a position beyond the model's joints"
_AS_GOOD = 0.05  # difference of mean correlations up to which two sets of velocities are alike
_SAME_UNIT = 0.3  # logarithm of the ratio of a velocity to the slope of its position up to which units agree
_SLOW = 40.0  # largest velocity of a log below which it is taken to be in rad/s, not in deg/s
_RELATED = 0.5  # correlation of both below which the column is not that velocity


def guess_layout(path: str | PathLike[str], model: Coordinates | None = None) -> str:
    """Guess the layout of a log from the names and values of its columns.

    Args:
        path: the log, in any format, or the files of one run.
        model: the coordinates to which the observed columns are matched: by name; or if there are as many, lengths to
            sliding joints, angles to hinges, and the others in order.

    Returns:
        The YAML file, for the user to correct.

    Raises:
        DataError: for a file that cannot be read as a table.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data.readers.guess import guess_layout
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> _ = path.write_text("t,hip,hip_vel,tau\\n0,0,1,0\\n0.01,0.01,1,0\\n0.02,0.02,1,0\\n")
        >>> print(guess_layout(path).split("columns:")[1])
        <BLANKLINE>
          - {name: "t", role: time, unit: "s"}  # check: the median step is 0.01, which is 0.01 s, 100 Hz
          - {name: "hip", role: observation, unit: "rad"}  # check the unit: the largest value is 0.02
          - {name: "hip_vel", role: observation, unit: "rad/s"}  # check the unit: the largest value is 1
          - {name: "tau", role: action, unit: "N·m"}  # check the unit: the largest value is 0
        <BLANKLINE>
    """
    contents = read_contents(path)
    columns = guess_columns(contents.values, None if model is None else model.quantities)
    columns = columns if model is None else without_constants(columns, contents, model)
    body = FreeBody(columns, {}) if model is None else free_body(columns, contents.values, list(model.units))
    columns = body.columns
    if model is not None:
        columns = _of_actuators(_servo_commands(columns, model) if model.servos else columns, model)
    slopes = Slopes(contents.values, time_of(columns, contents.values))
    columns = _one_set(columns, slopes)
    pairs: dict[str, str] = {}
    if model is not None and not contents.named:
        columns, contents = recognise(columns, contents, model)
        slopes = Slopes(contents.values, time_of(columns, contents.values))
    else:
        columns, pairs = _unnamed_velocities(columns, slopes, contents.named, model)
        columns = columns if model is None else _without_surplus(columns, body.coordinates, model)
        columns = columns if model is None else _actions_left(columns, contents, len(model.actuators))
    if model is not None and model.forces:
        columns = [replace(one, unit="N") if one.kind == "action" and one.unit == "N·m" else one for one in columns]
    columns, pairs = _without_strangers(columns, slopes, pairs | _pairs(columns, body.coordinates, pairs))
    columns = velocities_together(columns, body.coordinates)
    pairs = {
        column.name: pairs[column.name] for column in columns if column.kind == "velocity" and column.name in pairs
    }
    columns = _in_one_unit(columns, slopes, pairs)
    found = {} if model is None else coordinates_of(columns, pairs, model, body.coordinates)
    columns = columns if model is None else without_missing_joints(columns, found, model)
    columns = scaled(columns, contents, found, model)
    units = {column.name: column.unit for column in columns}
    columns = [_checked(column, slopes, pairs, found, model, units) for column in columns]
    return layout_text(path, contents, columns, pairs, slopes, found, [] if model is None else model.actuators)


def _of_actuators(columns: Sequence[Guess], model: Coordinates) -> list[Guess]:
    """If each actuator has a column of its name, these are the actions, the first of each, and no others."""
    own: dict[str, str] = {}
    for column in columns:
        if column.kind == "action" and column.of_model is not None:
            own.setdefault(column.of_model, column.name)
    if set(own) != set(model.actuators):
        return list(columns)
    note = "not an action: each of the model's actuators has a column of its name"
    others = [column for column in columns if column.kind == "action" and column.name not in own.values()]
    return [replace(column, kind="unknown", note=note) if column in others else column for column in columns]


def _one_set(columns: Sequence[Guess], slopes: Slopes) -> list[Guess]:
    """Keep one set of actions, of positions and of velocities: logs have commanded and measured, raw and filtered ones.

    The first one, or of velocities the first that follow their positions as well as any others do.
    """
    positions = [column for column in columns if column.kind == "position"]
    sets: dict[tuple[str, str], dict[str, list[float]]] = {}
    rivals: dict[str, tuple[str, str]] = {}
    for column in columns:
        position = _position_of(column, positions) if column.kind == "velocity" else None
        key = "".join(sign for sign in column.name if sign.isdigit()) or ("" if position is None else position.name)
        if column.kind in ("action", "position", "velocity") and key and column.of_model is None:
            rivals[column.name] = column.kind, key
            slope = None if position is None else slopes.of(position.name, column.name, position.unit)
            found = sets.setdefault((column.kind, key), {}).setdefault(_family(column), [])
            found.append(0.0 if slope is None else slope[0])
    result = []
    for column in columns:
        if (families := sets.get(rivals.get(column.name, ("", "")))) is not None:
            score = {name: float(np.mean(found)) for name, found in families.items()}
            chosen = next(name for name in score if score[name] >= max(score.values()) - _AS_GOOD)
            if _family(column) != chosen:
                note = f"looks like another {column.kind}; swap the roles if this is the one to use"
                column = replace(column, kind="unknown", note=note)
        result.append(column)
    return result


def _unnamed_velocities(
    columns: Sequence[Guess], slopes: Slopes, named: bool, model: Coordinates | None
) -> tuple[list[Guess], dict[str, str]]:
    """Velocities whose names do not tell that they are the slopes of others, such as q3 of q1, and their positions."""
    positions = [column for column in columns if column.kind == "position" and column.of_model is None]
    if model is not None and len(positions) <= sum(not name.endswith("_velocity") for name in model.units):
        return list(columns), {}
    groups = [[one for one in positions if _family(one) == family] for family in dict.fromkeys(map(_family, positions))]
    if not named and slopes.time is not None:
        left = [column for column in columns if column.kind == "unknown"]
        sizes = range(2 * (len(left) // 2), 0, -2)
        groups = [left[begin : begin + size] for size in sizes for begin in range(len(left) - size + 1)]
    for group in groups:
        unit = group[0].unit if named else "rad"
        if found := slopes_among([column.name for column in group], slopes, unit):
            kinds = dict.fromkeys(found, "velocity") | dict.fromkeys(found.values(), "position")
            units = dict.fromkeys(found, f"{to_si(unit)[0]}/s") | dict.fromkeys(found.values(), unit)
            note = "found as a slope, not by its name: check"
            return [
                replace(column, kind=kinds[column.name], unit=units[column.name], note=note)
                if column.name in kinds
                else column
                for column in columns
            ], found
    return list(columns), {}


def _servo_commands(columns: Sequence[Guess], model: Coordinates) -> list[Guess]:
    """The commands of servos, positions or velocities: those of the actuators' names, or desired ones, or others.

    The first of these of which there are as many as actuators. Torques beside them are no actions.
    """
    unit = next((column.unit for column in columns if column.kind == model.servos), "rad")
    desired = [column for column in columns if column.kind == f"desired {model.servos}"]
    others = [column for column in columns if column.kind == "action" and not is_force(column.name)]
    own = [column for column in others if column.of_model is not None]
    fitting = [each for each in (own, desired, desired + others) if len(each) == len(model.actuators)]
    commands = {column.name for column in next(iter(fitting), desired or others)}
    if not commands:
        return list(columns)
    said, result = f"the model's actuators are {model.servos} servos", []
    for column in columns:
        if column.name in commands:
            note = f"{said}: check the unit"
            own_unit = column.unit if column in desired else unit
            column = replace(column, kind="action", unit=own_unit, note=note)
        elif column.kind == "action":
            column = replace(column, kind="unknown", note=said)
        result.append(column)
    return result


def _without_surplus(columns: Sequence[Guess], of_body: Mapping[str, str], model: Coordinates) -> list[Guess]:
    """More positions than joints: if as many have a velocity as there are joints, the others are left out.

    Nothing is changed if one of the others has the name of a joint.
    """
    followed = set(_pairs(columns, of_body, {}).values())
    joints = [name for name in model.units if not name.endswith("_velocity") and name not in of_body.values()]
    positions = [one for one in columns if one.kind == "position" and one.name not in of_body]
    surplus = [one for one in positions if one.name not in followed]
    named = any(joint.lower() in one.name.lower() for joint in joints for one in surplus)
    if named or len(positions) <= len(joints) or len(followed) != len(joints):
        return list(columns)
    return [replace(one, kind="unknown", unit="1", note=_SURPLUS) if one in surplus else one for one in columns]


def _actions_left(columns: Sequence[Guess], contents: Contents, number: int) -> list[Guess]:
    """The columns that nothing recognised as actions, if there are as many as actuators and no other actions.

    Positions beyond the model's joints count only if no other column is left, and if their names tell no angle or
    length: Q may be a command.
    """
    values = contents.values
    left = [column for column in columns if column.kind == "unknown" and not column.note]
    surely = {_family(column) for column in left if may_be_command(column.name, np.asarray(values[column.name]))}
    left = [column for column in left if _family(column) in surely]
    surplus = [column for column in columns if column.note == _SURPLUS and kind_of_joint(column.name) is None]
    if any(column.kind == "action" for column in columns) or not number or not (left or surplus):
        return list(columns)
    chosen = left if len(left) == number else surplus if not left and len(surplus) == number else []
    if chosen:
        note = "not recognised, but as many columns as the model has actuators are left: check role and unit"
        return [replace(column, kind="action", note=note) if column in chosen else column for column in columns]
    maybe = [*left, *surplus]
    note = f"{PERHAPS}: actuators in the model: {number}, columns that are left: {len(maybe)}"
    return [replace(column, note=note) if column in maybe else column for column in columns]


def _family(column: Guess) -> str:
    """The name without digits: where i1 is a command, i2 is one too, also if it keeps its sign."""
    return "".join(sign for sign in column.name if not sign.isdigit())


def _position_of(velocity: Guess, positions: Sequence[Guess]) -> Guess | None:
    """The position of a velocity by its name, or else the only one with the same rest of the name."""
    for position in positions:
        if tuple(words_of(without_unit(position.name)[0])) == slope_of(velocity.name):
            return position
    same = [position for position in positions if position.stem == velocity.stem]
    return same[0] if len(same) == 1 else None


def _pairs(columns: Sequence[Guess], of_body: Collection[str], known: Mapping[str, str]) -> dict[str, str]:
    """Return the position of each velocity that is not known: by their names, or by order if as many are left."""
    pairs = dict(known)
    positions = [column for column in columns if column.kind == "position"]
    velocities = [column for column in columns if column.kind == "velocity" and column.name not in known]
    for velocity in velocities:
        left = [column for column in positions if column.name not in pairs.values()]
        if (position := _position_of(velocity, left)) is not None:
            pairs[velocity.name] = position.name
    rest = [p.name for p in positions if p.name not in pairs.values() and p.name not in of_body]
    alone = [v.name for v in velocities if v.name not in pairs and v.name not in of_body]
    return pairs | (dict(zip(alone, rest, strict=True)) if len(alone) == len(rest) else {})


def _checked(
    column: Guess,
    slopes: Slopes,
    pairs: Mapping[str, str],
    found: Mapping[str, str],
    model: Coordinates | None,
    units: Mapping[str, str],
) -> Guess:
    """Return the column with the unit of its coordinate or position, and with the slope of its position in the note."""
    note, unit = column.note, column.unit
    position = pairs.get(column.name)
    if position is not None and to_si(unit)[0] != f"{to_si(units[position])[0]}/s":
        unit = f"{to_si(units[position])[0]}/s"
    coordinate = found.get(column.name)
    if coordinate is not None and model is not None:
        if to_si(unit)[0] != to_si(model.units.get(coordinate, unit))[0]:
            unit = model.units[coordinate]
        note = f"{coordinate} of the model; {note}".rstrip("; ")
    if position is not None and (slope := slopes.of(position, column.name, units[position])) is not None:
        note = f"slope of {position}: {slope[1]:.3g} times this; {note}"
    return replace(column, unit=unit, note=note)


def _in_one_unit(columns: Sequence[Guess], slopes: Slopes, pairs: Mapping[str, str]) -> list[Guess]:
    """The columns, with the same unit of angle for positions and velocities that are their slopes in the file's units.

    Angles that are large for rad are degrees, unless their velocities would then be slow.
    """
    units = {column.name: column.unit for column in columns}
    for velocity, position in pairs.items():
        slope = slopes.of(position, velocity, units[position])
        stated = any(without_unit(name)[1] is not None for name in (position, velocity))
        if stated or slope is None or (units[position], units[velocity]) != ("deg", "rad/s"):
            continue
        if abs(math.log(max(abs(slope[1]), 1e-12))) < _SAME_UNIT:
            speeds = slopes.values.get(velocity)
            is_slow = speeds is None or float(np.nanmax(np.abs(speeds))) < _SLOW
            units |= {position: "rad"} if is_slow else {velocity: "deg/s"}
    return [replace(column, unit=units[column.name]) for column in columns]


def _without_strangers(
    columns: Sequence[Guess], slopes: Slopes, pairs: Mapping[str, str]
) -> tuple[list[Guess], dict[str, str]]:
    """Velocities that do not follow their positions as columns to ignore, and the pairs without them."""
    units = {column.name: column.unit for column in columns}
    found, kept = [], dict(pairs)
    for column in columns:
        position = pairs.get(column.name)
        slope = None if position is None else slopes.of(position, column.name, units[position])
        if slope is not None and abs(slope[0]) < _RELATED:
            del kept[column.name]
            note = f"not the slope of {position} (correlation {slope[0]:.2f}), which is estimated instead"
            column = replace(column, kind="unknown", note=note)
        found.append(column)
    return found, kept
