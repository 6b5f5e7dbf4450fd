"""Compare a column of velocities with the slope of its position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.roles import Guess, guess_columns, without_unit
from torchrl_h2o.data.readers.units import to_si

_SPANS = (1, 3, 10, 25, 60)  # rows over which displacements are compared with a velocity; the best span counts
_MOVES = 3.0  # times by which displacements over some rows exceed those over one row where a joint moves
_FOLLOWS = 0.9  # correlation above which a velocity without a time is the slope of its position
_AGREE = 1.2  # largest ratio of the steps that two joints tell
_SPANS_IN_LOG = 20  # spans that must fit into a log: over fewer, unrelated columns are alike by chance
_USUAL_STEPS = (1e-4, 1.0)  # times between two rows of a log, in s


def relation(
    velocity: Guess, contents: Contents, pairs: Mapping[str, str], units: Mapping[str, str]
) -> tuple[float, float] | None:
    """Correlation of displacements with the integral of a velocity, and their ratio; None if nothing moves."""
    if contents.values.get(pairs.get(velocity.name, "")) is None or (time := time_of(contents)) is None:
        return None
    return _relation_over(time, velocity, contents, pairs, units)


def step_of_motion(
    velocities: Sequence[Guess], contents: Contents, pairs: Mapping[str, str], units: Mapping[str, str]
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
        name, values = pairs.get(velocity.name, ""), contents.values.get(velocity.name)
        stated = without_unit(velocity.name)[1], without_unit(name)[1]
        if values is None or (stated[0] is None) != (stated[1] is None):
            continue
        found = _relation_over(np.arange(float(len(values))), velocity, contents, pairs, units, overlap=_SPANS_IN_LOG)
        if found is not None and found[0] > _FOLLOWS:
            factor = 1.0 if stated[0] is None else to_si(units[name])[1] / to_si(velocity.unit)[1]
            steps.append(factor * found[1])
    alike = bool(steps) and max(steps) < _AGREE * min(steps)
    step = float(np.median(steps)) if alike else 0.0
    return step if _USUAL_STEPS[0] <= step <= _USUAL_STEPS[1] else None


def _relation_over(
    time: np.ndarray,
    velocity: Guess,
    contents: Contents,
    pairs: Mapping[str, str],
    units: Mapping[str, str],
    *,
    overlap: int = 1,
) -> tuple[float, float] | None:
    """The same for given times, over spans of which as many fit into the log as ``overlap`` says."""
    name = pairs.get(velocity.name, "")
    position, values = contents.values.get(name), contents.values.get(velocity.name)
    if position is None or values is None or len(time) < 3:
        return None
    if is_wrapped(position, units[name]):
        position = np.unwrap(position, period=2.0 * np.pi / to_si(units[name])[1])
    steps, moved = np.diff(time), np.diff(position)
    expected = 0.5 * (values[1:] + values[:-1]) * steps
    known = np.isfinite(moved) & np.isfinite(expected)
    if not known.any():
        return None
    usual, largest = np.median(steps), 5.0 * np.quantile(np.abs(moved[known]), 0.95)
    good = known & (steps > 0.0) & (steps < 2.0 * usual) & (np.abs(moved) <= largest)  # no gaps and no resets
    moved, expected = np.where(known, moved, 0.0), np.where(known, expected, 0.0)
    spans = [rows for rows in _SPANS if overlap * rows < len(time)]
    if not spans:
        return None
    if max(np.nanstd(position[rows:] - position[:-rows]) for rows in spans) < _MOVES * np.std(moved[known]):
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


def time_of(contents: Contents) -> np.ndarray | None:
    """The time column in s."""
    for guess in guess_columns(contents.values):  # a model has no name for the time
        values = contents.values[guess.name]
        if guess.kind == "time" and values is not None:
            return values * to_si(guess.unit)[1]
    return None


def is_wrapped(values: np.ndarray | None, unit: str) -> bool:
    """Whether an angle jumps at the end of its range: its large steps all are turns."""
    si, factor = to_si(unit)
    if values is None or si != "rad":
        return False
    steps = np.abs(np.diff(values)) * factor
    large = steps[steps > 0.5 * np.pi]
    return bool(len(large) and (np.abs(large - 2.0 * np.pi) < 0.2 * np.pi).all())
