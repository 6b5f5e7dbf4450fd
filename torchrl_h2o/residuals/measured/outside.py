"""What happened from outside, such as a hand that pushes: stretches whose residual is far beyond what is usual there.

A joint limit or a contact that the simulator has wrong makes large residuals too, but again and again, at the same
states under the same actions: what recurs is physical, and is left to the effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals
from torchrl_h2o.residuals.simulation.simulation import Simulation

_NEIGHBOURS = 6  # events that began alike
_APART = 5  # windows: what is nearer in time is the same event
_QUANTILE = 0.8  # of their sizes: one of them may be a push itself
_TWICE = 2.0  # as large as what recurs there still counts as the same
_OFTEN = 0.003  # events a row: what happens more often is no exception, but what the simulator lacks
_MOST = 0.1  # of the windows, for the same reason
_ROUNDING = 1e-5  # of a dimension's spread: a residual within it is none


@dataclass(frozen=True)
class OutsideInterval:
    """A stretch of the data that something from outside disturbed.

    Args:
        start: its first row.
        stop: the row behind its last.
        size: the largest residual in it, in multiples of the usual one.
    """

    start: int
    stop: int
    size: float


def outside_intervals(
    simulation: Simulation,
    measured: Measured,
    *,
    horizon: int = 8,
    threshold: float = 12.0,
    states: np.ndarray | None = None,
) -> list[OutsideInterval]:
    """Finds what happened from outside.

    The residual at the end of short windows is compared with the usual one, and with that of the windows that began in
    similar states under similar actions at other times. It is sharper the less the simulator lacks: ask once before
    tracing, and once more with the mended simulator.

    Args:
        simulation: the simulator, with all effects known so far.
        measured: the data.
        horizon: control steps of the windows, shorter than what is looked for.
        threshold: how many times the usual residual is no longer usual.
        states: (T, nq + nv), to start from instead of the measured ones.

    Returns:
        The intervals, in order, each with a margin of one window on either side; none where large residuals are no
        exception.
    """
    starts = measured.windows(horizon)
    if len(starts) <= _NEIGHBOURS:
        return []
    size = _sizes(simulation, measured, starts, horizon, states)
    surprising = np.flatnonzero(size > threshold)
    if not _exceptional(starts[surprising], horizon, len(starts)):
        return []
    recurring = _recurring_sizes(_beginnings(simulation, measured, starts, horizon), starts, horizon, size, surprising)
    outside = surprising[size[surprising] > threshold * np.maximum(1.0, recurring / _TWICE)]
    return _intervals(starts[outside], size[outside], horizon, measured)


def still_outside(
    intervals: Sequence[OutsideInterval],
    simulation: Simulation,
    measured: Measured,
    *,
    horizon: int = 8,
    threshold: float = 12.0,
) -> list[OutsideInterval]:
    """Of intervals found with a poorer simulator, those that the mended one does not explain either.

    Args:
        intervals: as :func:`outside_intervals` found them.
        simulation: the mended simulator.
        measured: the data, with no interval left out.
        horizon: as for :func:`outside_intervals`.
        threshold: as for :func:`outside_intervals`.

    Returns:
        The intervals that remain, with the sizes that they have now.
    """
    starts = measured.windows(horizon)
    if not intervals or not len(starts):
        return []
    size = _sizes(simulation, measured, starts, horizon, None)
    remaining = []
    for interval in intervals:
        inside = (starts >= interval.start) & (starts < interval.stop)
        largest = float(size[inside].max(initial=0.0))
        if largest > threshold:
            remaining.append(replace(interval, size=largest))
    return remaining


def outside_rows(intervals: Sequence[OutsideInterval], rows: int) -> np.ndarray:
    """A mask, (rows), of the rows in the intervals: what :meth:`Measured.without` takes."""
    mask = np.zeros(rows, bool)
    for interval in intervals:
        mask[interval.start : interval.stop] = True
    return mask


def _exceptional(surprising: np.ndarray, horizon: int, windows: int) -> bool:
    """Whether windows with these first rows are few enough, and in few enough events, to be exceptions."""
    events = 1 + np.count_nonzero(np.diff(surprising) > horizon)
    return 0 < len(surprising) <= _MOST * windows and events <= max(2.0, _OFTEN * windows)


def _sizes(
    simulation: Simulation, measured: Measured, starts: np.ndarray, horizon: int, states: np.ndarray | None
) -> np.ndarray:
    return _in_usual_sizes(residuals(simulation, measured, starts, horizon, states=states)[:, -1], measured)


def _in_usual_sizes(residual: np.ndarray, measured: Measured) -> np.ndarray:
    """The size, (W), of the worst dimension of residuals (W, n), each in robust standard deviations."""
    usual = np.nanmedian(np.abs(residual), axis=0) / 0.6745
    usual = np.maximum(usual, _ROUNDING * measured.observation.std(0) + 1e-12)
    size = (np.abs(residual) / usual).max(1)
    return np.where(np.isfinite(size), size, 0.0)  # what diverges says nothing of a push


def _beginnings(simulation: Simulation, measured: Measured, starts: np.ndarray, horizon: int) -> np.ndarray:
    """What windows begin with, (W, k): the state, the mean action, the action before; each in its own spread."""
    action = executed_actions(simulation, measured)
    mean = action[starts[:, None] + np.arange(horizon)].mean(1)
    features = np.hstack([measured.observation[starts], mean, action[np.maximum(starts - 1, 0)]])
    spread = np.concatenate([measured.observation.std(0), action.std(0), action.std(0)])
    return features[:, spread > 0.0] / spread[spread > 0.0]


def _recurring_sizes(
    beginnings: np.ndarray, starts: np.ndarray, horizon: int, size: np.ndarray, chosen: np.ndarray
) -> np.ndarray:
    """How large residuals are, for each chosen window, in the events that began most like it at other times."""
    tree = cKDTree(beginnings)
    asked = min(len(starts), _NEIGHBOURS * (_APART + 1) * horizon)
    recurring = np.zeros(len(chosen))
    for position, window in enumerate(chosen):
        nearest = tree.query(beginnings[window], k=asked)[1]
        nearest = nearest[np.abs(starts[nearest] - starts[window]) > _APART * horizon]
        # of windows that overlap, the one that began most alike
        _, first = np.unique(starts[nearest] // horizon, return_index=True)
        events = nearest[np.sort(first)[:_NEIGHBOURS]]
        recurring[position] = np.quantile(size[events], _QUANTILE) if len(events) else 0.0
    return recurring


def _intervals(starts: np.ndarray, size: np.ndarray, horizon: int, measured: Measured) -> list[OutsideInterval]:
    """Windows with their margins, merged where they touch, cut at the ends of their runs."""
    merged: list[OutsideInterval] = []
    for start, its_size in zip(starts.tolist(), size.tolist(), strict=True):
        in_run = np.flatnonzero(measured.run == measured.run[start])
        begin, stop = max(start - horizon, int(in_run[0])), min(start + 2 * horizon, int(in_run[-1]) + 1)
        if merged and begin <= merged[-1].stop:
            last = merged.pop()
            begin, stop, its_size = last.start, max(stop, last.stop), max(its_size, last.size)
        merged.append(OutsideInterval(begin, stop, its_size))
    return merged
