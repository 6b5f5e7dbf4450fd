"""Recognise the columns of a log without names: by their order, or by which columns are the slopes of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
from torchrl_h2o.data.readers.guess.roles import LARGEST_ANGLE, Guess, clock, is_clock, is_counter
from torchrl_h2o.data.readers.guess.slopes import Slopes, is_wrapped

_ROWS = 5_000  # rows by which slopes are compared, those with the most motion
_SLOPE, _EACH = 0.8, 0.5  # mean and smallest correlation of velocities with the slopes of their positions
_AS_GOOD = 0.05  # difference of these means up to which two sets are alike
_COPY, _SIZE = 0.98, 0.1  # correlation, and share by which its size may differ, of a copy of a state
_AT_REST = "does not move, so only its place speaks for it"
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
    names = list(contents.values)
    first = contents.values[names[0]]
    begin = [clock("time", first)] if len(columns) > len(states + actions) and first is not None else []
    in_order = [*begin, *states, *actions]
    if len(columns) == len(in_order) and (begin or not is_clock(first)):
        found, notes = dict(zip(names, in_order, strict=True)), {}
    else:
        found, notes = _by_slopes(contents.values, model, states, actions)
    if not found:
        return list(columns), contents
    result = []
    for column in columns:
        new = found.get(column.name, Guess(column.name, "unknown"))
        note = "" if new.kind == "unknown" else notes.get(new.kind, "guessed from the model's order; check")
        result.append(replace(new, note="; ".join(filter(None, (note, new.note)))))
    values = {one.name: series for one, series in zip(result, contents.values.values(), strict=True)}
    return result, replace(contents, values=values)


@dataclass(frozen=True)
class _States:
    """Columns of positions and velocities, the mean correlation of the slopes, and how many joints move.

    A joint at rest has no slope to compare.
    """

    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    correlation: float
    moving: int


def _by_slopes(
    whole: Mapping[str, np.ndarray | None], model: Coordinates, states: Sequence[Guess], actions: Sequence[Guess]
) -> tuple[dict[str, Guess], dict[str, str]]:
    """The columns that were found, by name, and what to say of each kind of column."""
    positions = [state for state in states if state.kind == "position"]
    velocities = {state.name: state for state in states if state.kind == "velocity"}
    table = _liveliest(whole)
    time = _time_of(table)
    if time is None or {f"{one.name}_velocity" for one in positions} != set(velocities):  # a free body has a quaternion
        return {}, {}
    found, notes = {time: clock("time", whole[time])}, {"time": "grows in equal steps"}
    slopes = Slopes(table, table[time])
    sets = _states(slopes, [name for name in table if name != time], [one.unit for one in positions])
    if not sets:
        return found, notes
    order = {name: index for index, name in enumerate(table)}
    most = max(one.moving for one in sets)
    best = max(one.correlation for one in sets if one.moving == most)
    alike = [one for one in sets if one.moving == most and one.correlation > best - _AS_GOOD]
    slower = {one.velocities for one in alike}
    alike = [one for one in alike if one.positions not in slower] or alike  # velocities and accelerations
    chosen = min(alike, key=lambda one: [order[name] for name in (*one.positions, *one.velocities)])
    also = "; other columns may be too, such as commanded and measured ones" if len(alike) > 1 else ""
    notes |= {
        "position": f"recognised by its velocity, in the model's order{also}; check",
        "velocity": "recognised by its position; check",
        "action": "the first columns that may be commands; check role and unit",
    }
    degrees = any(_in_degrees(table[p], one.unit) for p, one in zip(chosen.positions, positions, strict=True))
    for position, velocity, one in zip(chosen.positions, chosen.velocities, positions, strict=True):
        unit = "deg" if degrees and one.unit == "rad" else one.unit
        rest = _AT_REST if slopes.of(position, velocity, one.unit) is None else ""
        found[position] = replace(one, unit=unit, note=rest or f"the largest value is {_largest(table[position]):.3g}")
        found[velocity] = replace(velocities[f"{one.name}_velocity"], unit=f"{unit}/s", note=rest)
    return found | dict(zip(_actions(slopes, set(found), chosen, model), actions, strict=False)), notes


def _time_of(table: Mapping[str, np.ndarray | None]) -> str | None:
    """The time: a clock that does not count rows, or else the first counter; None if there is none."""
    clocks = [name for name, series in table.items() if is_clock(series)]
    return next((name for name in clocks if not is_counter(table[name])), next(iter(clocks), None))


def _known(series: np.ndarray | None) -> np.ndarray:
    return np.zeros(2) if series is None else series


def _largest(series: np.ndarray | None) -> float:
    return float(np.abs(_known(series)).max())


def _in_degrees(series: np.ndarray | None, unit: str) -> bool:
    return unit == "rad" and (_largest(series) > LARGEST_ANGLE or is_wrapped(series, "deg"))


def _liveliest(table: Mapping[str, np.ndarray | None]) -> dict[str, np.ndarray | None]:
    """The neighbouring rows in which most moves: a log may begin at rest."""
    rows = max((len(series) for series in table.values() if series is not None), default=0)
    motion = {
        begin: sum(
            float(np.std(np.diff(series[begin : begin + _ROWS]))) / max(float(np.std(np.diff(series))), 1e-300)
            for series in table.values()
            if series is not None and np.isfinite(series).all()
        )
        for begin in range(0, max(rows - _ROWS // 2, 1), _ROWS)
    }
    first = max(motion, key=lambda begin: motion[begin])
    return {name: None if series is None else series[first : first + _ROWS] for name, series in table.items()}


def _states(slopes: Slopes, names: Sequence[str], units: Sequence[str]) -> list[_States]:
    """All sets of columns, block by block or in pairs, that are positions, of these units, and their slopes."""
    number, total = len(units), len(names)
    blocks = [
        (tuple(names[p : p + number]), tuple(names[v : v + number]))
        for p in range(total - number + 1)
        for v in range(total - number + 1)
        if abs(v - p) >= number
    ]
    if number > 1:
        pairs = [names[p : p + 2 * number] for p in range(total - 2 * number + 1)]
        blocks += [(tuple(both[::2]), tuple(both[1::2])) for both in pairs]
    found = []
    for positions, velocities in blocks:
        if any(slopes.values[name] is None for name in (*positions, *velocities)):
            continue
        moving, rejected = [], False
        for position, velocity, unit in zip(positions, velocities, units, strict=True):
            one = slopes.of(position, velocity, unit)
            if one is not None and (rejected := one[0] < _EACH):
                break
            moving += [] if one is None else [one[0]]
        if not rejected and moving and np.mean(moving) >= _SLOPE:
            found.append(_States(positions, velocities, float(np.mean(moving)), len(moving)))
    return found


def _actions(slopes: Slopes, taken: set[str], states: _States, model: Coordinates) -> tuple[str, ...]:
    """The first neighbouring columns behind the states, or else before, that may be the actuators' commands."""
    table, number = slopes.values, len(model.actuators)
    names = list(table)
    order = {name: index for index, name in enumerate(names)}
    blocks = [tuple(names[begin : begin + number]) for begin in range(len(names) - number + 1) if number]
    blocks = [block for block in blocks if not taken & set(block) and _may_be(block, table, states, model)]
    last = max(order[name] for name in (*states.positions, *states.velocities))

    def accelerations(block: Sequence[str]) -> int:
        """How many of the columns are the slope of a velocity, as the torque of an arm without friction is, too."""
        found = [[slopes.of(v, name) or (0.0, 0.0) for v in states.velocities] for name in block]
        return sum(any(correlation > _SLOPE for correlation, _ in each) for each in found)

    return min(blocks, key=lambda block: (accelerations(block), order[block[0]] < last, order[block[0]]), default=())


def _may_be(block: Sequence[str], table: Mapping[str, np.ndarray | None], states: _States, model: Coordinates) -> bool:
    """Whether columns may be commands: of servos, those that change follow the positions, else not all copy a state."""
    columns = [column for name in block if (column := table[name]) is not None and np.isfinite(column).all()]
    moving = [column for column in columns if np.ptp(column) > 0.0]
    if len(columns) < len(block) or not moving:
        return False
    if model.servos:
        return all(max(_alike(column, table[name]) for name in states.positions) > _SERVO for column in moving)
    seen = [table[name] for name in (*states.positions, *states.velocities)]
    return not all(any(_is_copy(column, state) for state in seen) for column in moving)


def _is_copy(column: np.ndarray, state: np.ndarray | None) -> bool:
    """Whether a column follows a state and has its size."""
    return _alike(column, state) > _COPY and abs(float(np.std(column) / np.std(_known(state))) - 1.0) < _SIZE


def _alike(one: np.ndarray | None, other: np.ndarray | None) -> float:
    """Correlation of two columns; 0 if one is constant."""
    if one is None or other is None or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
