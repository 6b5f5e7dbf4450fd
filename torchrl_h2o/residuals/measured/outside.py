"""Finds intervals disturbed from outside, such as pushes: their residuals are far larger than elsewhere.

A wrong joint limit or contact in the simulator also causes large residuals, but they recur at the same states under the
same actions. Recurring residuals are not treated as disturbances, because an effect may explain them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

from torchrl_h2o.residuals.measured.residual import executed_actions, residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

WINDOW_STEPS = 8  # control steps of the windows, shorter than the disturbances to find
THRESHOLD = 12.0  # residual, in multiples of the usual one, beyond which a window is surprising
NEIGHBOURS = 6  # number of events with a similar start that a surprising window is compared with
EVENTS_APART = 5  # distance between two events, in window lengths; windows closer in time belong to the same event
# quantile of the neighbours' residuals that is taken as recurring, because a neighbour may itself be a push
RECURRING_QUANTILE = 0.8
# multiple of the recurring residual up to which a residual is attributed to the same recurring cause
RECURRING_FACTOR = 2.0
MAX_EVENT_RATE = 0.003  # events per window beyond which large residuals are a fault of the simulator, not disturbances
# share of surprising windows beyond which large residuals are a fault of the simulator, not disturbances
MAX_SHARE = 0.1
ROUNDING = 1e-5  # residual, in spreads, up to which it counts as zero

DISTURBED = "disturbed from outside"  # reason for excluded rows


@dataclass(frozen=True)
class OutsideInterval:
    """An interval of the data that was disturbed from outside.

    Args:
        start: first row.
        stop: row after the last.
        size: largest residual, in multiples of the usual one.
    """

    start: int
    stop: int
    size: float


def outside_intervals(
    simulation: Simulation,
    measured: Measured,
) -> list[OutsideInterval]:
    """Finds intervals disturbed from outside.

    The residual at the end of short windows is compared with the usual one, and with the residuals of windows that
    began in similar states under similar actions at other times. A better simulator makes the test more
    sensitive, so repeat it with the mended simulator.

    Args:
        simulation: the simulator, with all effects known so far.
        measured: the data.

    Returns:
        The intervals in order, each with a margin of one window on either side; none if large residuals are
        frequent.
    """
    starts, size = _window_sizes(simulation, measured)
    if len(starts) <= NEIGHBOURS:
        return []
    surprising = np.flatnonzero(size > THRESHOLD)
    if not _exceptional(starts[surprising], len(starts)):
        return []
    recurring = _recurring_sizes(_beginnings(simulation, measured, starts), starts, size, surprising)
    limit = THRESHOLD * np.maximum(1.0, recurring / RECURRING_FACTOR)
    outside = surprising[size[surprising] > limit]
    return _intervals(starts[outside], size[outside], WINDOW_STEPS, measured)


def still_outside(
    intervals: Sequence[OutsideInterval],
    simulation: Simulation,
    measured: Measured,
) -> list[OutsideInterval]:
    """Selects the intervals that remain disturbed when compared with the mended simulator.

    Args:
        intervals: result of :func:`outside_intervals` with the simulator before it was mended.
        simulation: the mended simulator.
        measured: the data, with no interval excluded.

    Returns:
        The remaining intervals, with their sizes under the mended simulator.
    """
    if not intervals:
        return []
    starts, size = _window_sizes(simulation, measured)
    remaining = []
    for interval in intervals:
        inside = (starts >= interval.start) & (starts < interval.stop)
        largest = float(size[inside].max(initial=0.0))
        if largest > THRESHOLD:
            remaining.append(replace(interval, size=largest))
    return remaining


def without_intervals(measured: Measured, intervals: Sequence[OutsideInterval]) -> Measured:
    """The data with some intervals excluded as disturbed from outside."""
    rows = outside_rows(intervals, len(measured))
    return measured.without(rows, DISTURBED)


def outside_rows(intervals: Sequence[OutsideInterval], rows: int) -> np.ndarray:
    """Mask, (rows), of the rows in the intervals, for :meth:`Measured.without`."""
    mask = np.zeros(rows, bool)
    for interval in intervals:
        mask[interval.start : interval.stop] = True
    return mask


def _exceptional(surprising: np.ndarray, windows: int) -> bool:
    """Whether the windows with these first rows, and the events they form, are rare."""
    events = 1 + np.count_nonzero(np.diff(surprising) > WINDOW_STEPS)
    few_events = events <= max(2.0, MAX_EVENT_RATE * windows)
    return bool(0 < len(surprising) <= MAX_SHARE * windows and few_events)


def _window_sizes(simulation: Simulation, measured: Measured) -> tuple[np.ndarray, np.ndarray]:
    """First rows, (W), of all windows, and the residuals at their ends, (W).

    The size of a residual is that of its largest dimension, in robust standard deviations.
    """
    starts = measured.windows(WINDOW_STEPS)
    if not len(starts):
        return starts, np.zeros(0)
    residual = residuals(simulation, measured, starts, WINDOW_STEPS)[:, -1]
    usual = np.nanmedian(np.abs(residual), axis=0) / 0.6745
    usual = np.maximum(usual, ROUNDING * measured.observation.std(0) + 1e-12)
    size = (np.abs(residual) / usual).max(1)
    return starts, np.where(np.isfinite(size), size, 0.0)  # a diverged simulation does not indicate a push


def _beginnings(simulation: Simulation, measured: Measured, starts: np.ndarray) -> np.ndarray:
    """Features of each window's start, (W, k): observation, mean action and previous action, in their spreads."""
    action = executed_actions(simulation, measured)
    mean = action[starts[:, None] + np.arange(WINDOW_STEPS)].mean(1)
    features = np.hstack([measured.observation[starts], mean, action[np.maximum(starts - 1, 0)]])
    spread = np.concatenate([measured.observation.std(0), action.std(0), action.std(0)])
    return features[:, spread > 0.0] / spread[spread > 0.0]


def _recurring_sizes(beginnings: np.ndarray, starts: np.ndarray, size: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Quantile of the residuals of other events with the most similar starts, for each chosen window, (chosen)."""
    horizon, apart = WINDOW_STEPS, EVENTS_APART
    tree = cKDTree(beginnings)
    asked = min(len(starts), NEIGHBOURS * (apart + 1) * horizon)
    recurring = np.zeros(len(chosen))
    for position, window in enumerate(chosen):
        nearest = tree.query(beginnings[window], k=asked)[1]
        nearest = nearest[np.abs(starts[nearest] - starts[window]) > apart * horizon]
        # of overlapping windows, keep the one with the most similar start
        _, first = np.unique(starts[nearest] // horizon, return_index=True)
        events = nearest[np.sort(first)[:NEIGHBOURS]]
        recurring[position] = np.quantile(size[events], RECURRING_QUANTILE) if len(events) else 0.0
    return recurring


def _intervals(starts: np.ndarray, size: np.ndarray, horizon: int, measured: Measured) -> list[OutsideInterval]:
    """Windows with margins of one window, merged where they touch and cut at the ends of their runs."""
    merged: list[OutsideInterval] = []
    for start, its_size in zip(starts.tolist(), size.tolist(), strict=True):
        in_run = np.flatnonzero(measured.run == measured.run[start])
        begin, stop = max(start - horizon, int(in_run[0])), min(start + 2 * horizon, int(in_run[-1]) + 1)
        if merged and begin <= merged[-1].stop:
            last = merged.pop()
            begin, stop, its_size = last.start, max(stop, last.stop), max(its_size, last.size)
        merged.append(OutsideInterval(begin, stop, its_size))
    return merged
