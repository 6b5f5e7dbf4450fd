"""Checks of the rows: their order, repetitions and jumps; frozen, clipped and quantised columns."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.derivative import deviation, farthest, roughness, steps_of
from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import AuditedSimulation, Log, Pair
from torchrl_h2o.data.audit.orientation import turning_rates

CHECK = "rows"
REPEATED = 0.001  # share of repeated rows, of those in motion, from which they are a warning
MANY_REPEATED = 0.15  # the share from which they are severe
MOVING = 0.2  # velocity, in standard deviations, from which an equal next reading is no chance
JUMP = 0.5  # deviation of a position from the integral of its velocity, in standard deviations, that may be a jump
JUMP_NOISE = 8.0  # smallest jump, in usual deviations
MANY_JUMPS = 0.01  # share of jumps from which they are severe
SPIKE = 0.2  # share of a jump to which the next reading returns if the jump was a single wrong reading
MAX_SUSPECTS = 400  # rows with a possible jump that are compared with the simulator
BROKEN_RUNS = 0.2  # share of rows that do not continue the row before from which their order is lost
FROZEN_ROWS = 20  # shortest stretch of equal readings that counts as frozen
FROZEN_SEVERE = 0.1  # share of frozen rows from which they are severe
AT_END = 0.002  # share of readings at a column's extreme from which it is clipped
MOSTLY_AT_END = 0.3  # the share from which clipping is severe
QUANTUM_NOTE = 0.05  # resolution of a column, in standard deviations, from which a note is given
QUANTUM_WARNING = 0.12  # the resolution from which it is a warning
DUPLICATE_BLOCK = 20  # shortest stretch of rows that counts as recorded twice
SLOPE_ROWS = 10  # rows over which a position is differentiated beside a frozen velocity
ROUNDED = 0.01  # share of a constant velocity by which the slope of its position may differ from it


def check_rows(log: Log, simulation: AuditedSimulation) -> list[Finding]:
    """Order and repetition of rows, and each column's readings."""
    found = [*_order(log), *_repeated(log), *_duplicates(log)]
    ends = at_extremes(log)
    found += _jumps(log, simulation, ends)
    for column in range(len(log.names)):
        known = log.clipped & ends[:, column]
        if ends[:, column].sum() > 1.1 * known.sum():
            found.append(_clipped(log, column, ends[:, column]))
        found += _quantised(log, column)
    return [*found, *_frozen(log, ends), *_sensor_ranges(log)]


def _order(log: Log) -> list[Finding]:
    """Rows that do not continue the row before although no episode ended there."""
    breaks = log.run[1:] != log.run[:-1]
    if log.ended is not None:
        breaks &= ~log.ended[:-1]
    if breaks.sum() <= BROKEN_RUNS * len(log):
        return []
    words = f"{breaks.mean():.0%} of the rows do not begin where the row before ended: the transitions are shuffled or "
    remedy = "give the transitions in the order of their recording"
    return [Finding(CHECK, "severe", words + "thinned", Rows.of(np.flatnonzero(breaks) + 1), remedy)]


def _repeated(log: Log) -> list[Finding]:
    same, moving = (log.following == log.observation).all(1), _in_motion(log)
    share = (same & moving).sum() / max(1, moving.sum())
    if share <= REPEATED:
        return []
    severity = "severe" if share > MANY_REPEATED else "warning"
    words = f"{share:.1%} of the rows in motion repeat the row before in every sensor, as after a lost packet"
    remedy = "remove the repeated rows and split the log there, or write resample with a step in s, which interpolates "
    remedy += "over them, or log at the rate of the sensors"
    return [Finding(CHECK, severity, words, Rows.of(same & moving), remedy)]


def _in_motion(log: Log) -> np.ndarray:
    """Rows in which a joint moves so fast that an equal next reading is no chance, (T,)."""
    moving = np.zeros(len(log), bool)
    columns = {pair.position: 0.5 * (log.observation + log.following)[:, pair.velocity] for pair in log.pairs}
    if not columns:  # each column's own slope, over more rows than are lost together
        columns = {column: _slope(log, column) for column in range(len(log.names))}
    for column, velocity in columns.items():
        fast = np.abs(velocity) > MOVING * velocity.std()
        moving |= fast & (np.abs(velocity) * log.dt > 3.0 * _resolution(log.observation[:, column]))
    return moving


def _slope(log: Log, column: int) -> np.ndarray:
    """Mean slope of a column before or after each row, the smaller one, per second, (T,); 0 at the ends of runs.

    Beside a sudden stop, one of them is 0; lost packets leave both.
    """
    values, slope, rows = log.observation[:, column], np.zeros(len(log)), SLOPE_ROWS // 2
    middle = np.arange(rows, len(log) - rows)
    middle = middle[log.run[middle - rows] == log.run[middle + rows]]
    changes = values[middle] - values[middle - rows], values[middle + rows] - values[middle]
    slope[middle] = np.minimum(*np.abs(changes)) / (rows * log.dt)
    return slope


def _duplicates(log: Log) -> list[Finding]:
    """Stretches of rows that occur twice, such as a file that was appended to itself."""
    together = np.hstack([log.observation, log.action])
    _, first, inverse = np.unique(together, axis=0, return_index=True, return_inverse=True)
    back = np.arange(len(log)) - first[inverse.ravel()]
    again = np.zeros(len(log), bool)
    continued = (back[1:] == back[:-1]) & (back[1:] > DUPLICATE_BLOCK)
    for start, stop in _stretches(continued, DUPLICATE_BLOCK):
        again[start : stop + 1] = bool(np.any(np.ptp(log.observation[start : stop + 1], axis=0)))
    if not again.any():
        return []
    words = f"{again.mean():.0%} of the rows occur a second time, in the same order"
    remedy = "remove them: fitted and held-out rows would be the same"
    return [Finding(CHECK, "warning", words, Rows.of(again), remedy)]


def _jumps(log: Log, simulation: AuditedSimulation, ends: np.ndarray) -> list[Finding]:
    """Rows whose next position agrees neither with the integrated velocity nor with the simulator."""
    size = np.zeros(len(log))
    repeated = (log.following == log.observation).all(1)
    known = log.clipped | repeated | np.append(False, repeated[:-1])
    for pair in log.pairs:
        at_end = np.asarray(ends[:, pair.position] | ends[:, pair.velocity])
        left_out = known | at_end | np.append(at_end[1:], False)
        error = np.abs(_deviations(log, pair))
        spread = position_spread(log, pair)
        # where most rows jump, the usual deviation is that of jumps
        usual = max(min(JUMP_NOISE * deviation(error), spread), JUMP * spread)
        # a change of the velocity within the row explains deviations up to this size
        speed = np.maximum(
            2.0 * np.abs(log.following[:, pair.velocity] - log.observation[:, pair.velocity]),
            1.5 * log.observation[:, pair.velocity].std(),
        )
        size = np.maximum(size, np.where(left_out, 0.0, error / np.maximum(np.maximum(usual, log.dt * speed), 1e-12)))
    suspects = np.flatnonzero(size > 1.0)
    if not len(suspects):
        return []
    seen = suspects[np.unique(np.linspace(0, len(suspects) - 1, MAX_SUSPECTS).astype(int))]
    seen = seen[_surprising(log, simulation, seen)] if simulation.frame_skip < 100 else seen
    if not len(seen):
        return []
    share = len(seen) / min(len(suspects), MAX_SUSPECTS) * len(suspects) / len(log)
    if _spikes(log, seen) > 0.8:
        what, remedy = "single readings lie far beside their neighbours", "remove these readings and split the log"
    else:
        what = "positions jump to where neither their velocities nor the simulator lead: rows are missing, were put "
        what += "into another order, or belong to another run"
        remedy = "restore the order of the rows; where a run ends, mark it with done or a jump of time"
    severity = "severe" if share > MANY_JUMPS else "warning"
    return [Finding(CHECK, severity, f"after {share:.2%} of the rows {what}", Rows.of(seen), remedy)]


def position_spread(log: Log, pair: Pair) -> float:
    """Standard deviation of a position; of an angle that turns over and over, that within one turn."""
    spread = float(log.observation[:, pair.position].std())
    return min(spread, 2.0 * np.pi / np.sqrt(12.0)) if pair.angle and spread < 50.0 else spread


def _deviations(log: Log, pair: Pair) -> np.ndarray:
    """Displacement minus the integral of the velocity, (T,); turns of an angle by 2 π are removed."""
    displacement, integral, _ = steps_of(log, pair.position, pair.velocity)
    error = displacement - integral
    if pair.angle:
        turns = np.round(error / (2.0 * np.pi))
        near = np.abs(error - 2.0 * np.pi * turns) < 0.5
        error = np.where(near, error - 2.0 * np.pi * turns, error)
    return error


def _surprising(log: Log, simulation: AuditedSimulation, rows: np.ndarray) -> np.ndarray:
    """Mask of rows whose next position neither the integrated velocity nor a simulation from the row reproduces."""
    states = simulation.state_map.states(log.observation[rows])
    reached = simulation.state_map.observations(simulation.rollout(states, log.action[rows][:, None])[:, 0])
    surprising = np.zeros(len(rows), bool)
    for pair in log.pairs:
        error = log.following[rows, pair.position] - reached[:, pair.position]
        if pair.angle:
            error = error - 2.0 * np.pi * np.round(error / (2.0 * np.pi))
        limit = max(JUMP * position_spread(log, pair), farthest(log, pair))
        surprising |= ~(np.abs(error) <= limit) & (np.abs(_deviations(log, pair)[rows]) > limit)
    return surprising


def _spikes(log: Log, rows: np.ndarray) -> float:
    """Share of jumps that return within one row."""
    rows = rows[(rows > 0) & (rows < len(log) - 1)]
    positions = [pair.position for pair in log.pairs]
    to = np.abs(log.following[rows] - log.observation[rows])[:, positions]
    back = np.abs(log.following[rows + 1] - log.observation[rows])[:, positions]
    before = np.abs(log.following[rows] - log.observation[rows - 1])[:, positions]
    largest = to.argmax(1)
    pick = np.arange(len(rows)), largest
    return float((np.minimum(back, before)[pick] < SPIKE * to[pick]).mean()) if len(rows) else 0.0


def at_extremes(log: Log) -> np.ndarray:
    """Readings that equal the extreme of their column, in columns where these pile up, (T, n)."""
    found = np.zeros(log.observation.shape, bool)
    for column in range(log.observation.shape[1]):
        values = np.round(log.observation[:, column], 6)
        levels, counts = np.unique(values, return_counts=True)
        if len(levels) < 8:
            continue
        for end, beside in ((0, slice(1, 4)), (-1, slice(-4, -1))):
            many = counts[end] > max(5.0, AT_END * len(log))
            if not many or counts[end] <= 4.0 * counts[beside].max():
                continue
            at_end = values == levels[end]
            # one long stretch is a frozen sensor that happens to stop at an extreme
            longest = max((b - a for a, b in _stretches(at_end, 1)), default=0)
            if longest <= 0.5 * counts[end]:
                found[:, column] |= at_end
    return found


def _clipped(log: Log, column: int, ends: np.ndarray) -> Finding:
    values = np.unique(log.observation[ends, column])
    places = " and ".join(f"{value:.4g}" for value in (values[[0, -1]] if np.ptp(values) > 1e-5 else values[:1]))
    words = f"{ends.mean():.1%} of {log.names[column]} equal {places} {log.units[column]}: the signal is clipped"
    severity = "severe" if ends.mean() > MOSTLY_AT_END else "warning"
    return Finding(CHECK, severity, words, Rows.of(ends), "widen the range of the sensor, or leave these rows out")


def _quantised(log: Log, column: int) -> list[Finding]:
    values = log.observation[:, column]
    step, spread = _resolution(values), float(values.std())
    if not spread > 0.0 or step <= QUANTUM_NOTE * spread:
        return []
    words = f"{log.names[column]} has a resolution of {step:.3g} {log.units[column]}, {step / spread:.0%} of its "
    remedy = "log it with more digits or a finer sensor; until then, its noise limits what can be found"
    severity = "warning" if step > QUANTUM_WARNING * spread else "note"
    return [Finding(CHECK, severity, words + "standard deviation", None, remedy)]


def _resolution(values: np.ndarray) -> float:
    """Smallest step between readings, if they are multiples of it; 0 for a column without steps."""
    spread = float(np.std(values))
    if not spread > 0.0:
        return 0.0
    levels = np.unique(np.round(values / (1e-5 * spread)))
    if len(levels) < 3 or len(levels) > 0.5 * len(values):
        return 0.0
    steps = np.diff(levels)
    step = float(np.quantile(steps[steps > 2.0], 0.02)) if (steps > 2.0).any() else 0.0
    multiples = steps[steps > 2.0] / max(step, 1e-12)
    regular = np.abs(multiples - np.round(multiples)) < 0.1
    return 1e-5 * spread * step if step and regular.mean() > 0.9 else 0.0


def _frozen(log: Log, ends: np.ndarray) -> list[Finding]:
    """Stretches of equal readings that contradict what the other columns say of the motion."""
    found, same = [], log.run[1:] == log.run[:-1]
    for column, name in enumerate(log.names):
        values = log.observation[:, column]
        frozen = np.zeros(len(log), bool)
        still = (values[1:] == values[:-1]) & same & ~ends[1:, column]
        for start, stop in _stretches(still, FROZEN_ROWS):
            part = slice(start, stop + 1)
            frozen[part] = _contradicted(log, column, part)
        if frozen.any():
            severity = "severe" if frozen.mean() > FROZEN_SEVERE else "warning"
            remedy = "repair the sensor, or leave these rows out"
            found.append(Finding(CHECK, severity, f"{name} is frozen while the robot moves", Rows.of(frozen), remedy))
    return found


def _stretches(mask: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """First and last-plus-one index of each stretch of True of at least some length."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if b - a >= shortest]


def _contradicted(log: Log, column: int, part: slice) -> bool:
    """Whether other columns show that a column, equal in a stretch of rows, has to change there."""
    for pair in log.pairs:
        if column == pair.position:  # the velocity tells how far the joint moves
            distance = np.ptp(np.cumsum(log.observation[part, pair.velocity])) * log.dt
            values = log.observation[:, column]
            return bool(distance > max(3.0 * _resolution(values), 0.5 * MOVING * values.std()))
        if column == pair.velocity:
            values, seconds = log.observation[part, pair.position], SLOPE_ROWS * log.dt
            slopes = (values[SLOPE_ROWS:] - values[:-SLOPE_ROWS]) / seconds
            return _varies(log, column, part, slopes, roughness(log, pair.position) / seconds)
    for body in log.turning:
        if body.rates and column in body.rates:
            axis = body.rates.index(column)
            noise = 2.0 * max(roughness(log, one) for one in body.quaternion) / (SLOPE_ROWS * log.dt)
            return _varies(log, column, part, turning_rates(log, body, part, SLOPE_ROWS)[:, axis], noise)
        if body.rates and column in body.quaternion:  # one number of a turning body may well stay as it is
            equal = not np.ptp(log.observation[part][:, body.quaternion], axis=0).any()
            turned = np.ptp(np.cumsum(log.observation[part][:, body.rates], axis=0), axis=0).max() * log.dt
            return bool(equal and turned > 0.5 * MOVING)
    others = np.delete(log.observation, column, axis=1)
    spread = others.std(0)
    moved = others[part].std(0) > MOVING * spread
    return bool(moved[spread > 0.0].mean() > 0.5) if (spread > 0.0).any() else False


def _varies(log: Log, column: int, part: slice, slopes: np.ndarray, noise: float) -> bool:
    """Whether slopes contradict a velocity that is equal in a stretch of rows, by more than their noise.

    Constant slopes are no contradiction, as those of a free body, unless the velocity is 0.
    """
    values, constant = log.observation[:, column], log.observation[part.start, column]
    error = np.std(slopes) if constant else np.sqrt(np.mean(slopes**2))
    limits = 2.0 * _resolution(values), MOVING * values.std(), ROUNDED * abs(constant), 4.0 * noise
    return bool(error > max(limits))


def _sensor_ranges(log: Log) -> list[Finding]:
    share = log.clipped.mean()
    if share <= AT_END:
        return []
    words = (
        f"{share:.0%} of the rows hold a value at the end of the simulator's own sensor range; they are left out of "
    )
    remedy = "record slower motion, if the remaining rows are too few"
    return [Finding(CHECK, "warning" if share > 0.9 else "note", words + "fits", Rows.of(log.clipped), remedy)]
