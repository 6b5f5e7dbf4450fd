"""Write a guessed layout as YAML, with comments that say what to check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.coordinates import estimated_velocity
from torchrl_h2o.data.readers.guess.free_body import ORIENTATION, RATE
from torchrl_h2o.data.readers.guess.roles import PERHAPS, Guess
from torchrl_h2o.data.readers.guess.slopes import Slopes, is_wrapped, step_of_motion

JUMP = 0.5  # share of the median step by which a step must differ for the run to end there
UNEVEN, MANY = 0.2, 0.02  # clocks are irregular if more than a share of the steps differ from the median by this share


def layout_text(
    path: str | PathLike[str],
    contents: Contents,
    columns: Sequence[Guess],
    pairs: Mapping[str, str],
    slopes: Slopes,
    coordinates: Mapping[str, str],
    actuators: Sequence[str],
) -> str:
    """Return the YAML file.

    Args:
        path: the log.
        contents: what the log says of itself.
        columns: what each column is.
        pairs: positions by velocities; positions without one get an estimated velocity.
        slopes: the columns and the time.
        coordinates: the model's coordinate of each observed column.
        actuators: the model's actuators, whose order the actions get if they have their names.
    """
    kinds = [column.kind for column in columns]
    lines = [
        f"# The columns of {Path(path).name}, guessed from its names and values. Check every line: the unit in the",
        "# file, which is converted to SI, and the role (observation, action, reward, done, time, run or ignore).",
        *(f"{name}: {value}" for name, value in contents.options.items()),
    ]
    if "time" not in kinds:
        lines.append(_step(columns, slopes, pairs))
    of_actuators = {column.of_model: column.name for column in columns if column.kind == "action"}
    if set(of_actuators) == set(actuators) and list(of_actuators) != list(actuators):
        order = ", ".join(f'"{of_actuators[name]}"' for name in actuators)
        lines.append(f"action: [{order}]  # in the order of the model's actuators")
    if "action" not in kinds:
        perhaps = any(column.note.startswith(PERHAPS) for column in columns)
        which = f"; see those marked '{PERHAPS}'" if perhaps else ""
        lines.append(f"free_motion: true  # no column of actions was found{which}: remove this line if there is one")
    lines += _clock(slopes.time)
    lines.append("columns:")
    for column in columns:
        role = "observation" if column.kind in ("position", "velocity", ORIENTATION, RATE) else column.kind
        note = column.note
        if role.startswith("desired"):
            role, note = "ignore", f"a {role}; the role is action if the model's actuators are servos"
        elif role == "unknown":
            role, note = "ignore", note or "not recognised: observation, action or ignore?"
        unit = f', unit: "{column.unit}"' if role in ("observation", "action", "time", "euler") else ""
        unit += "" if column.scale == 1.0 else f", scale: {column.scale:.6g}"
        unit += "" if column.offset == 0.0 else f", offset: {column.offset:.6g}"
        if role in ("observation", "action") and is_wrapped(contents.values.get(column.name), column.unit):
            unit += ", unwrap: true"
            note = f"jumps by a turn; {'check that it begins in the turn of its position; ' * (role == 'action')}{note}"
        comment = f"  # {note}" if note else ""
        lines.append(
            f'  - {{name: "{column.name}", role: {role}{unit}{_coordinate(column.name, coordinates)}}}{comment}'
        )
    for column in columns:
        if column.kind == "position" and column.name not in pairs.values():
            name = estimated_velocity(column.name, contents.values)
            of = f'derivative_of: "{column.name}"{_coordinate(name, coordinates)}'
            entry = f'{{name: "{name}", role: observation, {of}}}'
            lines.append(f"  - {entry}  # no such column was found: it is estimated")
    return "\n".join(lines) + "\n"


def _coordinate(name: str, coordinates: Mapping[str, str]) -> str:
    """The entry with the model's coordinate of an observed column, if it has another name."""
    coordinate = coordinates.get(name, name)
    return "" if coordinate == name else f', coordinate: "{coordinate}"'


def _step(columns: Sequence[Guess], slopes: Slopes, pairs: Mapping[str, str]) -> str:
    """The time between two rows of a log without a column of time."""
    units = {column.name: column.unit for column in columns}
    step = step_of_motion([one for one in columns if one.kind == "velocity"], slopes, pairs, units)
    if step is None:
        return "dt: 0.01  # no column of time was found: give the time between two rows in s"
    words = "no column of time was found; with this time between two rows, in s, the velocities are the slopes of the"
    return f"dt: {step:.3g}  # {words} positions, if their units fit; check"


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
