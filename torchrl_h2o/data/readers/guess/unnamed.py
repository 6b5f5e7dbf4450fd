"""Recognise the columns of a log without names: by their order, or by which columns are the slopes of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
from torchrl_h2o.data.readers.guess.roles import LARGEST_ANGLE, Guess, guess_columns
from torchrl_h2o.data.readers.guess.slopes import is_wrapped, relation

_EVEN = 0.5  # share of the median by which a clock's usual step may differ from it
_MOSTLY, _MANY = 0.98, 0.8  # shares of the steps of a clock that are not backwards, and that are forwards
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
    table = list(contents.values.values())
    clock = [_clock(table[0])] if len(columns) > len(states + actions) and table[0] is not None else []
    in_order = [*clock, *states, *actions]
    if len(columns) == len(in_order) and (clock or not _is_clock(table[0])):
        found, notes = dict(enumerate(in_order)), {}
    else:
        found, notes = _by_slopes(contents, model, states, actions)
    if not found:
        return list(columns), contents
    result = []
    for index, column in enumerate(columns):
        new = found.get(index, Guess(column.name, "unknown"))
        note = "" if new.kind == "unknown" else notes.get(new.kind, "guessed from the model's order; check")
        result.append(replace(new, note="; ".join(filter(None, (note, new.note)))))
    values = {one.name: series for one, series in zip(result, contents.values.values(), strict=True)}
    return result, replace(contents, values=values)


@dataclass(frozen=True)
class _States:
    """Indices of the columns of positions and velocities, the mean correlation of the slopes, how many joints move.

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
    whole = list(contents.values.values())
    table = _liveliest(whole)
    time = _time_of(table)
    if time is None or {f"{one.name}_velocity" for one in positions} != set(velocities):  # a free body has a quaternion
        return {}, {}
    found, notes = {time: _clock(whole[time])}, {"time": "grows in equal steps"}
    slopes = _Slopes(table, time)
    sets = _states(slopes, [one.unit for one in positions])
    if not sets:
        return found, notes
    most = max(one.moving for one in sets)
    best = max(one.correlation for one in sets if one.moving == most)
    alike = [one for one in sets if one.moving == most and one.correlation > best - _AS_GOOD]
    slower = {one.velocities for one in alike}
    alike = [one for one in alike if one.positions not in slower] or alike  # velocities and accelerations
    chosen = min(alike, key=lambda one: (one.positions, one.velocities))
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


def _clock(series: np.ndarray | None) -> Guess:
    """The time, with the unit that its step suggests."""
    return guess_columns({"time": series})[0]


def _time_of(table: Sequence[np.ndarray | None]) -> int | None:
    """Index of the time: a clock that does not count rows, or else the first counter; None if there is none."""
    clocks = [index for index, series in enumerate(table) if _is_clock(series)]
    counters = [index for index in clocks if (np.diff(_known(table[index])) == 1.0).all()]
    return next((index for index in clocks if index not in counters), next(iter(clocks), None))


def _known(series: np.ndarray | None) -> np.ndarray:
    return np.zeros(2) if series is None else series


def _largest(series: np.ndarray | None) -> float:
    return float(np.abs(_known(series)).max())


def _in_degrees(series: np.ndarray | None, unit: str) -> bool:
    return unit == "rad" and (_largest(series) > LARGEST_ANGLE or is_wrapped(series, "deg"))


def _liveliest(table: Sequence[np.ndarray | None]) -> list[np.ndarray | None]:
    """The neighbouring rows in which most moves: a log may begin at rest."""
    rows = max((len(series) for series in table if series is not None), default=0)
    motion = {
        begin: sum(
            float(np.std(np.diff(series[begin : begin + _ROWS]))) / max(float(np.std(np.diff(series))), 1e-300)
            for series in table
            if series is not None and np.isfinite(series).all()
        )
        for begin in range(0, max(rows - _ROWS // 2, 1), _ROWS)
    }
    first = max(motion, key=lambda begin: motion[begin])
    return [None if series is None else series[first : first + _ROWS] for series in table]


def _is_clock(series: np.ndarray | None) -> bool:
    """Whether a column grows in steps that are mostly alike."""
    if series is None or len(series) < 3 or not np.isfinite(series).all():
        return False
    steps = np.diff(series)
    usual = float(np.median(steps))
    return (
        usual > 0.0
        and (steps >= 0.0).mean() >= _MOSTLY
        and (steps > 0.0).mean() >= _MANY
        and np.median(np.abs(steps - usual)) <= _EVEN * usual
    )


class _Slopes:
    """Correlations of columns with the slopes of others.

    Args:
        table: the columns; None for one that is not numbers.
        time: index of the time.
    """

    def __init__(self, table: Sequence[np.ndarray | None], time: int) -> None:
        self.table, self.time = table, time
        self._known: dict[tuple[int, int, str], float | None] = {}

    def of(self, position: int, velocity: int, unit: str) -> float | None:
        """Correlation of a column with the slope of another one; None if nothing moves."""
        key = position, velocity, unit
        if key not in self._known:
            columns = {"time": self.time, "position": position, "velocity": velocity}
            log = Contents({name: self.table[index] for name, index in columns.items()})
            pair = Guess("velocity", "velocity", f"{unit}/s")
            found = relation(pair, log, {"velocity": "position"}, {"position": unit})
            self._known[key] = None if found is None else found[0]
        return self._known[key]


def _states(all_slopes: _Slopes, units: Sequence[str]) -> list[_States]:
    """All sets of columns, block by block or in pairs, that are positions, of these units, and their slopes."""
    table, time, number = all_slopes.table, all_slopes.time, len(units)
    found = []
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
            one = all_slopes.of(position, velocity, unit)
            if one is not None and one < _EACH:
                break
            slopes.append(one)
        moving = [one for one in slopes if one is not None]
        if len(slopes) == number and moving and np.mean(moving) >= _SLOPE:
            found.append(_States(positions, velocities, float(np.mean(moving)), len(moving)))
    return found


def _actions(slopes: _Slopes, taken: set[int], states: _States, model: Coordinates) -> tuple[int, ...]:
    """The first neighbouring columns behind the states, or else before, that may be the actuators' commands."""
    table, number = slopes.table, len(model.actuators)
    blocks = [tuple(range(begin, begin + number)) for begin in range(len(table) - number + 1)]
    blocks = [block for block in blocks if not taken & set(block) and _may_be(block, table, states, model)]
    last = max(*states.positions, *states.velocities)

    def accelerations(block: Sequence[int]) -> int:
        """How many of the columns are the slope of a velocity, as the torque of an arm without friction is, too."""
        return sum(any((slopes.of(v, index, "1") or 0.0) > _SLOPE for v in states.velocities) for index in block)

    return min(blocks, key=lambda block: (accelerations(block), block[0] < last, block[0]), default=())


def _may_be(block: Sequence[int], table: Sequence[np.ndarray | None], states: _States, model: Coordinates) -> bool:
    """Whether columns may be commands: of servos, those that change follow the positions, else not all copy a state."""
    columns = [column for index in block if (column := table[index]) is not None and np.isfinite(column).all()]
    moving = [column for column in columns if np.ptp(column) > 0.0]
    if len(columns) < len(block) or not moving:
        return False
    if model.servos:
        return all(max(_alike(column, table[index]) for index in states.positions) > _SERVO for column in moving)
    seen = [table[index] for index in (*states.positions, *states.velocities)]
    return not all(any(_is_copy(column, state) for state in seen) for column in moving)


def _is_copy(column: np.ndarray, state: np.ndarray | None) -> bool:
    """Whether a column follows a state and has its size."""
    return _alike(column, state) > _COPY and abs(float(np.std(column) / np.std(_known(state))) - 1.0) < _SIZE


def _alike(one: np.ndarray | None, other: np.ndarray | None) -> float:
    """Correlation of two columns; 0 if one is constant."""
    if one is None or other is None or np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])
