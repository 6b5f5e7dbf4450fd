"""Compare columns of velocities with the slopes of positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from torchrl_h2o.data.readers.guess.roles import Guess, without_unit
from torchrl_h2o.data.readers.units import to_si

_SPANS = (1, 3, 10, 25, 60)  # rows over which displacements are compared with a velocity; the best span counts
_MOVES = 3.0  # times by which displacements over some rows exceed those over one row where a joint moves
_FOLLOWS = 0.9  # correlation above which a velocity without a time is the slope of its position
_AGREE = 1.2  # largest ratio of the steps that two joints tell
_SPANS_IN_LOG = 20  # spans that must fit into a log: over fewer, unrelated columns are alike by chance
_USUAL_STEPS = (1e-4, 1.0)  # times between two rows of a log, in s
_EXACT, _SAME = 0.99, 0.02  # correlation, and share by which its ratio may differ, of a slope that no name tells


class Slopes:
    """Correlations of columns with the slopes of others.

    Args:
        values: the columns; None for one that is not numbers.
        time: the time of each row in s; None if there is none.
    """

    def __init__(self, values: Mapping[str, np.ndarray | None], time: np.ndarray | None) -> None:
        self.values, self.time = values, time
        self._known: dict[tuple[str, str, str], tuple[float, float] | None] = {}

    def of(self, position: str | None, velocity: str, unit: str = "1") -> tuple[float, float] | None:
        """Correlation of displacements with the integral of a velocity, and their ratio.

        Args:
            position: the column of positions.
            velocity: the column of velocities.
            unit: unit of the positions; an angle that jumps by a turn is unwrapped.

        Returns:
            None if nothing moves, or without a time.
        """
        key = position or "", velocity, unit
        if key not in self._known:
            self._known[key] = None if self.time is None else self._relation(self.time, *key)
        return self._known[key]

    def per_row(self, position: str, velocity: str, unit: str) -> tuple[float, float] | None:
        """The same with the number of a row as its time, so that the ratio is the time between two rows."""
        values = self.values.get(velocity)
        rows = np.zeros(0) if values is None else np.arange(float(len(values)))
        return self._relation(rows, position, velocity, unit, overlap=_SPANS_IN_LOG)

    def _relation(
        self, time: np.ndarray, position: str, velocity: str, unit: str, *, overlap: int = 1
    ) -> tuple[float, float] | None:
        """Over spans of which as many fit into the log as ``overlap`` says."""
        place, speed = self.values.get(position), self.values.get(velocity)
        if place is None or speed is None or len(time) < 3:
            return None
        if is_wrapped(place, unit):
            place = np.unwrap(place, period=2.0 * np.pi / to_si(unit)[1])
        steps, moved = np.diff(time), np.diff(place)
        expected = 0.5 * (speed[1:] + speed[:-1]) * steps
        known = np.isfinite(moved) & np.isfinite(expected)
        spans = [rows for rows in _SPANS if overlap * rows < len(time)]
        if not known.any() or not spans:
            return None
        usual, largest = np.median(steps), 5.0 * np.quantile(np.abs(moved[known]), 0.95)
        good = known & (steps > 0.0) & (steps < 2.0 * usual) & (np.abs(moved) <= largest)  # no gaps and no resets
        moved, expected = np.where(known, moved, 0.0), np.where(known, expected, 0.0)
        if max(np.nanstd(place[rows:] - place[:-rows]) for rows in spans) < _MOVES * np.std(moved[known]):
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


def slopes_among(names: Sequence[str], slopes: Slopes, unit: str) -> dict[str, str]:
    """Return the position of each velocity among columns whose names tell them not apart, such as q1 to q4.

    The first half are positions and the second half their exact slopes, or each velocity is beside its position.
    Without a time, at least two must tell the same time between two rows.

    Args:
        names: the columns, in the order of the file.
        slopes: all columns.
        unit: unit of the positions.

    Returns:
        Positions by velocities; empty if the columns are not of this kind.
    """
    half = len(names) // 2
    per_row = slopes.time is None
    for pairs in (
        dict(zip(names[half:], names[:half], strict=False)),
        dict(zip(names[1::2], names[::2], strict=False)),
    ):
        ratios = []
        for speed, place in pairs.items():
            found = (slopes.per_row if per_row else slopes.of)(place, speed, unit)
            if found is None or found[0] < _EXACT:
                break
            ratios.append(found[1])
        same = np.median(ratios) if per_row and ratios else 1.0
        least = 2 if per_row else 1
        if 2 * len(ratios) == len(names) >= 2 * least and (np.abs(np.array(ratios) - same) <= _SAME * same).all():
            return pairs
    return {}


def step_of_motion(
    velocities: Sequence[Guess], slopes: Slopes, pairs: Mapping[str, str], units: Mapping[str, str]
) -> float | None:
    """The time between two rows, in s, with which the velocities are the slopes of their positions.

    Where neither column's name says a unit, both are taken to have the same one; where one of them does, the pair says
    nothing. Noise as large as a velocity makes the step too small, by up to a tenth.

    Returns:
        None if no velocity follows its position in a log that is long enough to tell, if the joints disagree, or if
        nobody logs that fast or slowly: then a unit is wrong.
    """
    steps = []
    for velocity in velocities:
        name = pairs.get(velocity.name)
        if name is None or (without_unit(velocity.name)[1] is None) != (without_unit(name)[1] is None):
            continue
        found = slopes.per_row(name, velocity.name, units[name])
        if found is not None and found[0] > _FOLLOWS:
            stated = without_unit(velocity.name)[1] is not None
            factor = to_si(units[name])[1] / to_si(velocity.unit)[1] if stated else 1.0
            steps.append(factor * found[1])
    alike = bool(steps) and max(steps) < _AGREE * min(steps)
    step = float(np.median(steps)) if alike else 0.0
    return step if _USUAL_STEPS[0] <= step <= _USUAL_STEPS[1] else None


def time_of(columns: Sequence[Guess], values: Mapping[str, np.ndarray | None]) -> np.ndarray | None:
    """The time column in s."""
    for guess in columns:
        time = values.get(guess.name)
        if guess.kind == "time" and time is not None:
            return time * to_si(guess.unit)[1]
    return None


def is_wrapped(values: np.ndarray | None, unit: str) -> bool:
    """Whether an angle jumps at the end of its range: its large steps all are turns."""
    si, factor = to_si(unit)
    if values is None or si != "rad":
        return False
    steps = np.abs(np.diff(values)) * factor
    large = steps[steps > 0.5 * np.pi]
    return bool(len(large) and (np.abs(large - 2.0 * np.pi) < 0.2 * np.pi).all())
