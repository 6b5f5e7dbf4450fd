"""Checks whether each velocity is the derivative of its position: exchanged columns, units, signs, lags, noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.data.audit.derivative import (
    KNOWN_FACTOR,
    RELATED,
    SCALE_SEVERE,
    SCALE_WARNING,
    Derivative,
    deviation,
    related,
    steps_of,
    windowed,
)
from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import Log, Pair
from torchrl_h2o.data.audit.orientation import check_orientation
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.time import common_factor

CHECK = "kinematics"
FINE = 0.7  # correlation of successive velocities below which rows are too far apart for small errors to show
LAG_WARNING = 1.5  # rows of lateness from which a warning is given; below, a note
NOISE_WARNING = 0.12  # noise of a sensor, in standard deviations, from which a warning is given
NOISE_SEVERE = 0.6  # the noise from which it is severe
BIAS_WARNING = 0.3  # constant error of a velocity, in its standard deviations, from which a warning is given
# factor between a position's derivative and its velocity -> what it looks like, for position and for velocity
_FACTORS = (
    (180.0 / np.pi, "the position looks like degrees, the velocity like rad/s"),
    (np.pi / 180.0, "the velocity looks like degrees per second, the position like rad"),
    (1000.0, "the position is in thousandths of the velocity's unit (mm and m/s, mrad and rad/s)"),
    (0.001, "the velocity is in thousandths of the position's unit per second (mm/s and m, mrad/s and rad)"),
    (100.0, "the position is in hundredths of the velocity's unit (cm and m/s)"),
    (0.01, "the velocity is in hundredths of the position's unit per second (cm/s and m)"),
    (1.0 / (2.0 * np.pi), "the position looks like revolutions, the velocity like rad/s"),
    (2.0 * np.pi, "the velocity looks like revolutions per second, the position like rad"),
    (np.pi / 30.0, "the velocity looks like rpm, the position like rad"),
)
_DEGREES = (0, 1)  # the first two of them, which no wrong time explains
_ESTIMATED = "derivative_of estimates it from the position"
_BETTER_SENSOR = "use a better sensor, or filter positions and velocities alike before logging"
_BETTER_VELOCITY = f"leave the column out: {_ESTIMATED}; or use a better sensor"


def check_kinematics(
    log: Log, derivatives: Sequence[Derivative], noise: np.ndarray, step: Response | None
) -> list[Finding]:
    """Compares each position with its velocity, and looks for wrapped angles and noise.

    Args:
        log: the data.
        derivatives: fits of all pairs.
        noise: upper estimates of the noise of each observation, (n,).
        step: windows of one control step; None if the simulator was not consulted.
    """
    found = [*_without_velocity(log), *check_orientation(log)]
    time_is_wrong = common_factor(derivatives) is not None
    exchanged: set[str] = set()
    for index, derivative in enumerate(derivatives):
        pair = derivative.pair
        wrapped = _wrapped(log, pair)
        found += wrapped
        if wrapped or not _moves(log, pair) or not np.isfinite(derivative.factor):  # too few rows to tell
            continue
        filtered = _lag(log, derivative)
        if abs(derivative.correlation) < RELATED:
            if filtered and derivative.correlation > 0.5 * RELATED:
                found += filtered
            elif pair.name not in exchanged:
                found.append(_unrelated(log, index, derivatives, exchanged))
            continue
        if not time_is_wrong and not _explained(derivative, step):
            wrong = _factor(log, derivative, alone=len(derivatives) == 1)
            found += wrong and (_swapped(log, pair) or wrong)
        found += filtered
        found += _bias(log, derivative, step)
    return [*found, *_noisy(log, noise)]


def _without_velocity(log: Log) -> list[Finding]:
    if not log.alone:
        return []
    words = f"no velocity is given for {', '.join(log.alone)}: the simulator alone would have to tell it, with all its "
    remedy = "add a column for each to the description of the log, such as {name: hip_velocity, role: observation, "
    return [Finding(CHECK, "warning", words + "errors", None, remedy + "derivative_of: hip}")]


def _moves(log: Log, pair: Pair) -> bool:
    """Whether position and velocity both change, by more than rounding."""
    values = log.observation[:, [pair.position, pair.velocity]]
    return bool((np.ptp(values, axis=0) > 1e-9 * np.abs(values).max(0)).all())


def _explained(derivative: Derivative, step: Response | None) -> bool:
    """Whether the simulator reproduces the positions; a factor other than 1 is then due to coarse sampling."""
    low, high = SCALE_SEVERE
    if step is None or not low <= derivative.factor <= high:
        return False
    log, pair = step.log, derivative.pair
    rows = step.starts
    displacement, integral, _ = steps_of(log, pair.position, pair.velocity)
    plain = deviation((displacement - integral)[rows])
    return deviation(step.error[:, pair.position]) < 0.7 * plain


def _factor(log: Log, derivative: Derivative, *, alone: bool) -> list[Finding]:
    pair, factor = derivative.pair, derivative.factor
    low, high = SCALE_SEVERE if _coarse(log, pair) else SCALE_WARNING
    if low <= factor <= high:
        return []
    size = abs(factor)
    words = f"the derivative of {pair.name} is {factor:.3g} × {pair.velocity_name}"
    if factor < 0.0:
        words += ": one of them has the wrong sign"
    remedy = "correct unit, scale or sign of the columns"
    if not low <= size <= high:
        distance = [abs(np.log(size / known)) for known, _ in _FACTORS]
        nearest = int(np.argmin(distance))
        known = distance[nearest] < KNOWN_FACTOR
        if known:
            words += f": {_FACTORS[nearest][1]}"
        if alone and factor > 0.0 and not (known and nearest in _DEGREES):
            remedy += f", or the time between two rows: the motion fits {1e3 * factor * log.dt:.3g} ms"
    far = not SCALE_SEVERE[0] <= factor <= SCALE_SEVERE[1]
    return [Finding(CHECK, "severe" if far else "warning", words, None, remedy)]


def _unrelated(log: Log, index: int, derivatives: Sequence[Derivative], exchanged: set[str]) -> Finding:
    """The cause of a velocity that is not the derivative of its position."""
    derivative = derivatives[index]
    pair = derivative.pair
    remedy, (low, high) = "correct the order of the columns", SCALE_SEVERE
    if swapped := _swapped(log, pair):
        return swapped[0]
    for other in derivatives:
        velocity = other.pair.velocity
        if other is derivative:
            continue
        factor, _, correlation = related(log, *steps_of(log, pair.position, velocity))
        if abs(correlation) > 0.9 and low <= abs(factor) <= high:
            exchanged |= {pair.name, other.pair.name}
            words = f"the derivative of {pair.name} is {other.pair.velocity_name}, not {pair.velocity_name}: the "
            return Finding(CHECK, "severe", words + "columns of these joints are exchanged", None, remedy)
    words = f"{pair.velocity_name} is not the derivative of {pair.name} (correlation {derivative.correlation:.2f})"
    displacement, _, good = steps_of(log, pair.position, pair.velocity)
    visible = np.std(windowed(log, displacement, good, 8)) > 3.0 * derivative.position_noise
    remedy = "check what these columns hold; if a sensor is broken, leave it out"
    return Finding(CHECK, "severe" if visible else "warning", words, None, remedy)


def _coarse(log: Log, pair: Pair) -> bool:
    """Whether the rows are too far apart for small errors of scale and noise to show."""
    speed = log.observation[:, pair.velocity]
    return bool(np.corrcoef(speed[:-1], speed[1:])[0, 1] < FINE)


def _swapped(log: Log, pair: Pair) -> list[Finding]:
    """Whether the column of the position holds the derivative of that of the velocity."""
    factor, _, correlation = related(log, *steps_of(log, pair.velocity, pair.position))
    low, high = SCALE_SEVERE
    if correlation <= 0.9 or not low <= factor <= high:
        return []
    words = f"{pair.name} and {pair.velocity_name} are exchanged: the second is the integral of the first"
    return [Finding(CHECK, "severe", words, None, "correct the order of the columns")]


def _lag(log: Log, derivative: Derivative) -> list[Finding]:
    pair, lag = derivative.pair, derivative.lag
    if abs(lag) < 0.9:
        return []
    by = f"by {abs(lag):.1f} rows ({1e3 * abs(lag) * log.dt:.3g} ms) against the derivative of {pair.name}"
    if lag > 0.0:
        words, remedy = f"is late {by}, as a filtered velocity", "log the velocity without its filter"
    else:
        words, remedy = f"is early {by}", "shift the column by as many rows towards later ones"
    severity = "warning" if abs(lag) >= LAG_WARNING else "note"
    return [Finding(CHECK, severity, f"{pair.velocity_name} {words}", None, f"{remedy}, or leave it out: {_ESTIMATED}")]


def _bias(log: Log, derivative: Derivative, step: Response | None) -> list[Finding]:
    pair = derivative.pair
    spread = float(log.observation[:, pair.velocity].std())
    if abs(derivative.bias) <= BIAS_WARNING * spread or _explained(derivative, step):
        return []
    words = f"{pair.velocity_name} differs by {-derivative.bias:.3g} {pair.unit}/s from the derivative of {pair.name}"
    return [Finding(CHECK, "warning", words, None, "subtract the sensor's offset")]


def _wrapped(log: Log, pair: Pair) -> list[Finding]:
    if not pair.angle:
        return []
    moved, integral, _ = steps_of(log, pair.position, pair.velocity)
    for turn, unit in ((2.0 * np.pi, "2 π"), (360.0, "360")):
        turns = (np.abs(moved) > 0.5 * turn) & (np.abs(np.abs(moved) - turn) < 0.1 * turn)
        turns &= np.abs(integral) < 0.25 * turn
        # otherwise the position is in another unit, or its rows are out of order
        if turns.sum() > 0.8 * (np.abs(moved) > 0.25 * turn).sum() > 0.0:
            words = f"{pair.name} jumps by {unit}: the angle is wrapped"
            remedy = "write unwrap: true in its column: the simulator counts turns"
            return [Finding(CHECK, "warning", words, Rows.of(turns), remedy)]
    return []


def _noisy(log: Log, noise: np.ndarray) -> list[Finding]:
    found, estimated = [], np.zeros(len(log.names)) if log.estimated_std is None else log.estimated_std
    # for other columns there is no estimate that fast motion does not enter
    for pair, column in [(p, column) for p in log.pairs for column in (p.position, p.velocity)]:
        name = log.names[column]
        spread = float(log.observation[:, column].std())
        limit = spread * NOISE_WARNING * (2.0 if _moves(log, pair) and _coarse(log, pair) else 1.0)
        if not np.isfinite(noise[column]) or noise[column] <= limit:
            continue
        words = f"{name} has noise of {noise[column]:.3g} {log.units[column]}, {noise[column] / spread:.0%} of its "
        severity = "severe" if noise[column] > NOISE_SEVERE * spread else "warning"
        remedy = _BETTER_VELOCITY if column == pair.velocity and not estimated[column] else _BETTER_SENSOR
        found.append(Finding(CHECK, severity, words + "standard deviation", None, remedy))
    return found
