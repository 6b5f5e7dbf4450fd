"""Recognise the columns of a log without names: by their order, or by which columns are the slopes of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
from torchrl_h2o.data.readers.guess.roles import Guess
from torchrl_h2o.data.readers.guess.slopes import relation

_EVEN = 0.5  # share of the median by which a clock's usual step may differ from it
_MOSTLY = 0.98  # share of the steps of a clock that are forwards
_ROWS = 5_000  # rows by which slopes are compared
_SLOPE, _EACH = 0.8, 0.5  # mean and smallest correlation of velocities with the slopes of their positions
_AS_GOOD = 0.05  # difference of these means up to which two sets are alike
_COPY = 0.98  # correlation from which a column follows another one
_SERVO = 0.8  # correlation of a servo's command with its position


def recognise(columns: Sequence[Guess], contents: Contents, model: Coordinates) -> tuple[list[Guess], Contents]:
    """The columns with the model's names, and the log with these; both as they are if nothing fits.

    As many columns as the model has coordinates and actuators, with one more for the time, are taken in the model's
    order. Among more columns, those of the velocities are found as the slopes of the positions.

    Args:
        columns: a guess for each column, in the order of the file.
        contents: the log.
        model: the coordinates and actuators.
    """
    states = [
        Guess(name, "velocity" if name.endswith("_velocity") else "position", unit, name)
        for name, unit in model.units.items()
    ]
    actions = [Guess(f"{name}_command" if name in model.units else name, "action") for name in model.actuators]
    in_order = [*([Guess("time", "time", "s")] if len(columns) > len(states + actions) else []), *states, *actions]
    if len(columns) == len(in_order):
        found, notes = dict(enumerate(in_order)), {}
    else:
        found, notes = _by_slopes(contents, model, states, actions)
    if not found:
        return list(columns), contents
    result = []
    for index, column in enumerate(columns):
        new = found.get(index, Guess(column.name, "unknown"))
        note = "" if new.kind == "unknown" else notes.get(new.kind, "guessed from the model's order; check")
        result.append(replace(new, note=note))
    values = {one.name: series for one, series in zip(result, contents.values.values(), strict=True)}
    return result, replace(contents, values=values)


@dataclass(frozen=True)
class _States:
    """Indices of the columns of positions and of their velocities, the mean correlation of the slopes, and of how many.

    A joint at rest has no slope to compare.
    """

    positions: tuple[int, ...]
    velocities: tuple[int, ...]
    correlation: float
    moving: int


def _by_slopes(
    contents: Contents, model: Coordinates, states: Sequence[Guess], actions: Sequence[Guess]
) -> tuple[dict[int, Guess], dict[str, str]]:
    """The columns that were found, by index, and what to say of each kind of column."""
    positions = [state for state in states if state.kind == "position"]
    velocities = {state.name: state for state in states if state.kind == "velocity"}
    table = [None if series is None else series[:_ROWS] for series in contents.values.values()]
    time = next((index for index, series in enumerate(table) if _is_clock(series)), None)
    if time is None or {f"{one.name}_velocity" for one in positions} != set(velocities):  # a free body has a quaternion
        return {}, {}
    found, notes = {time: Guess("time", "time", "s")}, {"time": "grows in equal steps; check"}
    sets = _states(table, time, [one.unit for one in positions])
    if not sets:
        return found, notes
    most = max(one.moving for one in sets)
    best = max(one.correlation for one in sets if one.moving == most)
    alike = [one for one in sets if one.moving == most and one.correlation > best - _AS_GOOD]
    chosen = min(alike, key=lambda one: (one.positions, one.velocities))
    also = "; other columns may be too, such as commanded and measured ones" if len(alike) > 1 else ""
    notes |= {
        "position": f"recognised by its velocity, in the model's order{also}; check",
        "velocity": "recognised by its position; check",
        "action": "the first columns that may be commands; check role and unit",
    }
    found |= dict(zip(chosen.positions, positions, strict=True))
    found |= {v: velocities[f"{one.name}_velocity"] for v, one in zip(chosen.velocities, positions, strict=True)}
    return found | dict(zip(_actions(table, set(found), chosen, model), actions, strict=False)), notes


def _is_clock(series: np.ndarray | None) -> bool:
    """Whether a column grows in steps that are mostly alike."""
    if series is None or len(series) < 3 or not np.isfinite(series).all():
        return False
    steps = np.diff(series)
    usual = float(np.median(steps))
    return usual > 0.0 and (steps > 0.0).mean() >= _MOSTLY and np.median(np.abs(steps - usual)) <= _EVEN * usual


def _states(table: Sequence[np.ndarray | None], time: int, units: Sequence[str]) -> list[_States]:
    """All sets of columns, block by block or in pairs, that are positions, of these units, and their slopes."""
    found, known, number = [], {}, len(units)

    def slope(position: int, velocity: int, unit: str) -> float | None:
        """Correlation of a column with the slope of another one; None if nothing moves."""
        if (position, velocity, unit) not in known:
            three = Contents({"time": table[time], "position": table[position], "velocity": table[velocity]})
            pair = Guess("velocity", "velocity", f"{unit}/s", "velocity", "")
            ratio = relation(pair, three, {"velocity": "position"}, {"position": unit})
            known[position, velocity, unit] = None if ratio is None else ratio[0]
        return known[position, velocity, unit]

    total = len(table)
    blocks = [
        (tuple(range(p, p + number)), tuple(range(v, v + number)))
        for p in range(total - number + 1)
        for v in range(total - number + 1)
        if abs(v - p) >= number
    ]
    if number > 1:
        blocks += [
            (tuple(range(p, p + 2 * number, 2)), tuple(range(p + 1, p + 2 * number, 2)))
            for p in range(total - 2 * number + 1)
        ]
    for positions, velocities in blocks:
        if time in positions or time in velocities or any(table[i] is None for i in (*positions, *velocities)):
            continue
        slopes = []
        for position, velocity, unit in zip(positions, velocities, units, strict=True):
            one = slope(position, velocity, unit)
            if one is not None and one < _EACH:
                break
            slopes.append(one)
        moving = [one for one in slopes if one is not None]
        if len(slopes) == number and moving and np.mean(moving) >= _SLOPE:
            found.append(_States(positions, velocities, float(np.mean(moving)), len(moving)))
    return found


def _actions(
    table: Sequence[np.ndarray | None], taken: set[int], states: _States, model: Coordinates
) -> tuple[int, ...]:
    """The first neighbouring columns behind the states, or else before, that may be the actuators' commands."""
    number = len(model.actuators)
    blocks = [tuple(range(begin, begin + number)) for begin in range(len(table) - number + 1)]
    last = max(*states.positions, *states.velocities)
    blocks.sort(key=lambda block: (block[0] < last, block[0]))
    return next((block for block in blocks if not taken & set(block) and _may_be(block, table, states, model)), ())


def _may_be(block: Sequence[int], table: Sequence[np.ndarray | None], states: _States, model: Coordinates) -> bool:
    """Whether columns may be commands: of servos, they follow the positions, else they follow no state."""
    columns = [table[index] for index in block]
    if any(column is None or np.ptp(column) == 0.0 for column in columns):
        return False
    if model.servos:
        return all(max(_alike(column, table[index]) for index in states.positions) > _SERVO for column in columns)
    seen = (*states.positions, *states.velocities)
    return not any(_alike(column, table[index]) > _COPY for column in columns for index in seen)


def _alike(one: np.ndarray | None, other: np.ndarray | None) -> float:
    """Correlation of two columns; 0 if one is constant."""
    if one is None or other is None or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
