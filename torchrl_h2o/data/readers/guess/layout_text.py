"""Write the guessed layout of a log as YAML, with comments that say what to check."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents, read_contents
from torchrl_h2o.data.readers.guess.free_body import ORIENTATION, RATE, FreeBody, free_body, velocities_together
from torchrl_h2o.data.readers.guess.roles import Guess, guess_columns, is_force, may_be_command
from torchrl_h2o.data.readers.units import to_si

JUMP = 0.5  # share of the median step by which a step must differ for the run to end there
UNEVEN, MANY = 0.2, 0.02  # clocks are irregular if more than a share of the steps differ from the median by this share

_SPANS = (1, 3, 10, 25, 60)  # rows over which displacements are compared with a velocity; the best span counts
_MOVES = 3.0  # times by which displacements over some rows exceed those over one row where a joint moves
_RELATED = 0.5  # correlation of both below which the column is not that velocity


@dataclass(frozen=True)
class Coordinates:
    """The coordinates and actuators of a model, for their names and units.

    Args:
        units: the unit of each coordinate by its name, positions before velocities; velocities end in ``_velocity``.
        actuators: the actuators' names.
        servos: whether all actuators are position servos, whose commands are desired positions.
        forces: whether all actuators push along an axis, as a propeller or a linear motor does.
    """

    units: Mapping[str, str]
    actuators: Sequence[str]
    servos: bool = False
    forces: bool = False

    @property
    def quantities(self) -> dict[str, tuple[str, str | None]]:
        """Kind and unit of each name, None for actuators; a name of a joint and an actuator is the joint's."""
        actions: dict[str, tuple[str, str | None]] = dict.fromkeys(self.actuators, ("action", None))
        return actions | {
            name: ("velocity" if name.endswith("_velocity") else "position", unit) for name, unit in self.units.items()
        }


@dataclass(frozen=True)
class GuessedLayout:
    """A guess for the user to correct.

    Args:
        text: the YAML file.
        coordinates: the model's coordinate of each observed column whose name differs; empty without a model.
    """

    text: str
    coordinates: Mapping[str, str]


def guess_layout(path: str | Path, model: Coordinates | None = None) -> GuessedLayout:
    """Guess the layout of a log from the names and values of its columns.

    Args:
        path: the log, in any format.
        model: the coordinates to which the observed columns are matched by name, or by order if there are as many.

    Raises:
        DataError: for a file that cannot be read as a table.

    Example:
        >>> import pathlib, tempfile
        >>> from torchrl_h2o.data.readers.guess import guess_layout
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> _ = path.write_text("t,hip,hip_vel,tau\\n0,0,1,0\\n0.01,0.01,1,0\\n0.02,0.02,1,0\\n")
        >>> print(guess_layout(path).text.split("columns:")[1])
        <BLANKLINE>
          - {name: "t", role: time, unit: "s"}  # check: the median step is 0.01, which is 0.01 s, 100 Hz
          - {name: "hip", role: observation, unit: "rad"}  # check the unit: the largest value is 0.02
          - {name: "hip_vel", role: observation, unit: "rad/s"}  # check the unit: the largest value is 1
          - {name: "tau", role: action, unit: "N·m"}  # check the unit: the largest value is 0
        <BLANKLINE>
    """
    contents = read_contents(path)
    columns = guess_columns(contents.values, None if model is None else model.quantities)
    body = FreeBody(columns, {}) if model is None else free_body(columns, contents.values, list(model.units))
    columns = body.columns
    columns = _one_set(_servo_commands(columns) if model is not None and model.servos else columns)
    if model is not None and not contents.named:
        columns = _by_order(columns, model)
    elif model is not None:
        columns = _actions_left(columns, contents, len(model.actuators))
    if model is not None and model.forces:
        columns = [replace(one, unit="N") if one.kind == "action" and one.unit == "N·m" else one for one in columns]
    columns, pairs = _without_strangers(columns, contents, _pairs(columns, body.coordinates))
    columns = velocities_together(columns, body.coordinates)
    pairs = {
        column.name: pairs[column.name] for column in columns if column.kind == "velocity" and column.name in pairs
    }
    found = {} if model is None else _coordinates(columns, pairs, model, body.coordinates)
    units = {column.name: column.unit for column in columns}
    columns = [_checked(column, contents, pairs, found, model, units) for column in columns]
    return GuessedLayout(
        _text(path, contents, columns, pairs), {name: other for name, other in found.items() if name != other}
    )


def _one_set(columns: Sequence[Guess]) -> list[Guess]:
    """Keep the first set of actions, of positions and of velocities: logs have commanded and measured ones."""
    kept: dict[tuple[str, str], str] = {}
    result = []
    for column in columns:
        digits = "".join(sign for sign in column.name if sign.isdigit())
        key, rest = (column.kind, digits), _family(column)
        if column.kind in ("action", "position", "velocity") and digits and kept.setdefault(key, rest) != rest:
            note = f"looks like another {column.kind}; swap the roles if this is the one to use"
            column = replace(column, kind="unknown", note=note)
        result.append(column)
    return result


def _servo_commands(columns: Sequence[Guess]) -> list[Guess]:
    """Desired positions, or else other commands than forces, as the actions of servos, and no torques beside them."""
    positions = [column for column in columns if column.kind == "position"]
    commands = {column.name: column.unit for column in columns if column.kind == "desired position"}
    if not commands:
        unit = positions[0].unit if positions else "rad"
        named = [column.name for column in columns if column.kind == "action" and not is_force(column.name)]
        commands = dict.fromkeys(named, unit)
    if not commands:
        return list(columns)
    result = []
    for column in columns:
        if column.name in commands:
            note = "the model's actuators are servos, which take positions: check the unit"
            column = replace(column, kind="action", unit=commands[column.name], note=note)
        elif column.kind == "action":
            column = replace(column, kind="unknown", note="the model's actuators are servos, which take positions")
        result.append(column)
    return result


def _by_order(columns: Sequence[Guess], model: Coordinates) -> list[Guess]:
    """Without names: positions, velocities and actions in the model's order, after a time if there is one more."""
    kinds = ["velocity" if name.endswith("_velocity") else "position" for name in model.units]
    kinds += ["action"] * len(model.actuators)
    units = [*model.units.values(), *["1"] * len(model.actuators)]
    names = [*model.units, *model.actuators]
    if len(columns) == len(kinds) + 1:
        kinds, units, names = ["time", *kinds], ["s", *units], ["time", *names]
    if len(columns) != len(kinds):
        return list(columns)
    note = "guessed from the model's order; check"
    return [Guess(*parts, note=note) for parts in zip(names, kinds, units, names, strict=True)]


def _actions_left(columns: Sequence[Guess], contents: Contents, number: int) -> list[Guess]:
    """The columns that nothing recognised as actions, if there are as many as actuators and no other actions."""
    values = contents.values
    left = [column for column in columns if column.kind == "unknown" and not column.note]
    surely = {_family(column) for column in left if may_be_command(column.name, np.asarray(values[column.name]))}
    left = [column for column in left if _family(column) in surely]
    if len(left) != number or any(column.kind == "action" for column in columns):
        return list(columns)
    note = "not recognised, but as many columns as the model has actuators are left: check role and unit"
    return [replace(column, kind="action", note=note) if column in left else column for column in columns]


def _family(column: Guess) -> str:
    """The name without digits: where i1 is a command, i2 is one too, also if it keeps its sign."""
    return "".join(sign for sign in column.name if not sign.isdigit())


def _pairs(columns: Sequence[Guess], of_body: Collection[str]) -> dict[str, str]:
    """Return the position of each velocity: by the rest of their names, or by order if as many are left."""
    positions = [column for column in columns if column.kind == "position"]
    velocities = [column for column in columns if column.kind == "velocity"]
    pairs: dict[str, str] = {}
    for velocity in velocities:
        same = [p.name for p in positions if p.stem == velocity.stem and p.name not in pairs.values()]
        if len(same) == 1:
            pairs[velocity.name] = same[0]
    rest = [p.name for p in positions if p.name not in pairs.values() and p.name not in of_body]
    alone = [v.name for v in velocities if v.name not in pairs and v.name not in of_body]
    return pairs | (dict(zip(alone, rest, strict=True)) if len(alone) == len(rest) else {})


def _coordinates(
    columns: Sequence[Guess], pairs: Mapping[str, str], model: Coordinates, of_body: Mapping[str, str]
) -> dict[str, str]:
    """Return the coordinate of each position and velocity, also of the velocities that are to be estimated."""
    taken = set(of_body.values())
    joints = [name for name in model.units if not name.endswith("_velocity") and name not in taken]
    positions = [column.name for column in columns if column.kind == "position" and column.name not in of_body]
    found: dict[str, str] = {}
    for joint in sorted(joints, key=len, reverse=True):
        like = [name for name in positions if joint.lower() in name.lower() and name not in found]
        if like:
            found[min(like, key=len)] = joint
    if not found and len(positions) == len(joints):
        found = dict(zip(positions, joints, strict=True))
    observed = ("position", "velocity", ORIENTATION, RATE)
    found |= {
        column.name: of_body[column.name] for column in columns if column.name in of_body and column.kind in observed
    }
    velocity_of = {position: velocity for velocity, position in pairs.items()}
    for position, joint in list(found.items()):
        if f"{joint}_velocity" in model.units:
            estimated = _estimated(position, [column.name for column in columns])
            found[velocity_of.get(position, estimated)] = f"{joint}_velocity"
    return found


def _checked(
    column: Guess,
    contents: Contents,
    pairs: Mapping[str, str],
    found: Mapping[str, str],
    model: Coordinates | None,
    units: Mapping[str, str],
) -> Guess:
    """Return the column with the unit of its coordinate or position, and with the slope of its position in the note."""
    note, unit = column.note, column.unit
    if column.name in pairs and to_si(unit)[0] != f"{to_si(units[pairs[column.name]])[0]}/s":
        unit = f"{to_si(units[pairs[column.name]])[0]}/s"
    coordinate = found.get(column.name)
    if coordinate is not None and model is not None:
        if to_si(unit)[0] != to_si(model.units[coordinate])[0]:
            unit = model.units[coordinate]
        note = f"{coordinate} of the model; {note}".rstrip("; ")
    relation = _relation(column, contents, pairs, units)
    if relation is not None:
        note = f"slope of {pairs[column.name]}: {relation[1]:.3g} times this; {note}"
    return replace(column, unit=unit, note=note)


def _without_strangers(
    columns: Sequence[Guess], contents: Contents, pairs: Mapping[str, str]
) -> tuple[list[Guess], dict[str, str]]:
    """Velocities that do not follow their positions as columns to ignore, and the pairs without them."""
    units = {column.name: column.unit for column in columns}
    found, kept = [], dict(pairs)
    for column in columns:
        relation = _relation(column, contents, pairs, units)
        if relation is not None and abs(relation[0]) < _RELATED:
            del kept[column.name]
            note = f"not the slope of {pairs[column.name]} (correlation {relation[0]:.2f}), which is estimated instead"
            column = replace(column, kind="unknown", note=note)
        found.append(column)
    return found, kept


def _relation(
    velocity: Guess, contents: Contents, pairs: Mapping[str, str], units: Mapping[str, str]
) -> tuple[float, float] | None:
    """Correlation of displacements with the integral of a velocity, and their ratio; None if nothing moves."""
    name = pairs.get(velocity.name, "")
    position, values, time = contents.values.get(name), contents.values.get(velocity.name), _time(contents)
    if position is None or values is None or time is None or len(time) < 3:
        return None
    if _is_wrapped(position, units[name]):
        position = np.unwrap(position, period=2.0 * np.pi / to_si(units[name])[1])
    steps, moved = np.diff(time), np.diff(position)
    expected = 0.5 * (values[1:] + values[:-1]) * steps
    usual, largest = np.median(steps), 5.0 * np.quantile(np.abs(moved), 0.95)
    good = (steps > 0.0) & (steps < 2.0 * usual) & (np.abs(moved) <= largest)  # no gaps and no resets
    spans = [rows for rows in _SPANS if rows < len(time)]
    if max(np.std(position[rows:] - position[:-rows]) for rows in spans) < _MOVES * np.std(moved):
        return None  # noise of a joint at rest does not grow with the span
    found = [_correlation(moved, expected, good, rows) for rows in spans]
    return max((one for one in found if one is not None), key=lambda one: abs(one[0]), default=None)


def _correlation(moved: np.ndarray, expected: np.ndarray, good: np.ndarray, rows: int) -> tuple[float, float] | None:
    """Correlation of displacements over some rows with those expected, and their ratio; None where nothing moves."""
    bad = np.concatenate([[0], np.cumsum(~good)])
    whole = bad[rows:] == bad[:-rows]
    sums = (np.concatenate([[0.0], np.cumsum(each)]) for each in (moved, expected))
    moved, expected = ((each[rows:] - each[:-rows])[whole] for each in sums)
    if len(moved) < 3:
        return None
    level = max(np.abs(moved).max(), 1e-300), max(np.abs(expected).max(), 1e-300)
    moved, expected = moved - moved.mean(), expected - expected.mean()
    if np.abs(moved).max() < 1e-6 * level[0] or np.abs(expected).max() < 1e-6 * level[1]:
        return None  # a constant velocity has no correlation
    size = np.sqrt((moved @ moved) * (expected @ expected))
    return (float(moved @ expected / size), float(moved @ expected / (expected @ expected))) if size > 0.0 else None


def _time(contents: Contents) -> np.ndarray | None:
    """The time column in s."""
    for guess in guess_columns(contents.values):  # a model has no name for the time
        values = contents.values[guess.name]
        if guess.kind == "time" and values is not None:
            return values * to_si(guess.unit)[1]
    return None


def _estimated(position: str, taken: Collection[str]) -> str:
    """Name of the estimated velocity of a position, that no column of the file has."""
    name = f"{position}_velocity"
    return f"{name}_estimated" if name in taken else name


def _text(path: str | Path, contents: Contents, columns: Sequence[Guess], pairs: Mapping[str, str]) -> str:
    kinds = [column.kind for column in columns]
    lines = [
        f"# The columns of {Path(path).name}, guessed from its names and values. Check every line: the unit in the",
        "# file, which is converted to SI, and the role (observation, action, reward, done, time or ignore).",
        *(f"{name}: {value}" for name, value in contents.options.items()),
    ]
    if "time" not in kinds:
        lines.append("dt: 0.01  # no column of time was found: give the time between two rows in s")
    if "action" not in kinds:
        lines.append("free_motion: true  # no column of actions was found: remove this line if there is one")
    lines += _clock(_time(contents))
    lines.append("columns:")
    for column in columns:
        role = "observation" if column.kind in ("position", "velocity", ORIENTATION, RATE) else column.kind
        note = column.note
        if role.startswith("desired"):
            role, note = "ignore", f"a {role}; the role is action if the model's actuators are servos"
        elif role == "unknown":
            role, note = "ignore", note or "not recognised: observation, action or ignore?"
        unit = f', unit: "{column.unit}"' if role in ("observation", "action", "time") else ""
        if role in ("observation", "action") and _is_wrapped(contents.values.get(column.name), column.unit):
            unit += ", unwrap: true"
            note = f"jumps by a turn; {'check that it begins in the turn of its position; ' * (role == 'action')}{note}"
        comment = f"  # {note}" if note else ""
        lines.append(f'  - {{name: "{column.name}", role: {role}{unit}}}{comment}')
    for column in columns:
        if column.kind == "position" and column.name not in pairs.values():
            entry = (
                f'name: "{_estimated(column.name, contents.values)}", role: observation, derivative_of: "{column.name}"'
            )
            lines.append(f"  - {{{entry}}}  # no such column was found: it is estimated")
    return "\n".join(lines) + "\n"


def _is_wrapped(values: np.ndarray | None, unit: str) -> bool:
    """Whether an angle jumps at the end of its range: its large steps all are turns."""
    si, factor = to_si(unit)
    if values is None or si != "rad":
        return False
    steps = np.abs(np.diff(values)) * factor
    large = steps[steps > 0.5 * np.pi]
    return bool(len(large) and (np.abs(large - 2.0 * np.pi) < 0.2 * np.pi).all())


def _clock(time: np.ndarray | None) -> list[str]:
    """What to do about irregular time steps: split at few late rows, resample if many steps differ."""
    if time is None or len(time) < 2:
        return []
    steps = np.diff(time)
    usual = float(np.median(steps))
    uneven = float((np.abs(steps - usual) > UNEVEN * usual).mean())
    if uneven > MANY and usual > 0.0:
        mean = float(np.mean(steps[steps <= 2.0 * usual]))  # 300 Hz with stamps in ms: steps of 3 and 4 ms
        why = f"{uneven:.0%} of the time steps differ by more than {UNEVEN:.0%}, and the simulator takes equal ones"
        split = "on_time_jump: split  # runs end at gaps longer than 1.5 steps; time_tolerance: 3 allows 4 steps"
        return [f"resample: {mean:.3g}  # s; {why}", split]
    jumps = int((np.abs(steps - usual) > JUMP * usual).sum())
    words = f"{jumps} of {len(steps)} time steps differ by more than half: runs end there"
    return [f"on_time_jump: split  # {words}"] if jumps else []
