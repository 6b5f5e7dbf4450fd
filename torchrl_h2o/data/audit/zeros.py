"""Check of the zeros of angles: small shifts, and large ones in all rows or in some."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.log import Pair
from torchrl_h2o.data.audit.regression import (
    BETTER,
    FOREIGN,
    MISFIT,
    SIGNIFICANCE,
    friction_responses,
    percent,
    robust_fit,
    unexplained,
)
from torchrl_h2o.data.audit.response import Response

CHECK = "model"
ZERO_WARNING = 0.1  # error of an angle's zero, in rad, from which a warning is given
ZERO_SEVERE = 0.5  # the error, in rad, from which it is severe, and sought in parts of the log as well
ZERO_CHANGE = 5.0  # sum over windows of unexplained shares by which a change of a zero must lower them
ZERO_GAIN = 0.03  # unexplained share of a window that a large shift must explain at least
ZERO_EXPLAINED = 0.5  # share of the accelerations that a large shift, gains and friction may leave unexplained
ZERO_BETTER = 0.8  # share of the misfit that a corrected zero must leave at most
_GRIDS = ((30.0, 180.0), (5.0, 30.0), (1.0, 5.0))  # steps and half widths of successive grids of shifts, in degrees
_FEWEST, _SMALLEST = 12, 0.04  # windows of a part of the log with its own zero, and their share of all
_COARSE = 100  # windows with which a shift is sought first


def check_large_zeros(response: Response) -> list[Finding]:
    """Angles whose zero lies far from the model's, or changes in the log, as that of an encoder that loses counts.

    Each angle is shifted by steps of 30° around the circle, in all windows. If no single shift explains the log, the
    Viterbi algorithm divides it into parts with a shift each, such that the simulator's error is least; a change
    within a run must lower it by more than chance, and lasts until the run ends or another change. The best shifts
    have to explain far more than gains, friction, constant forces and small shifts of all zeros can, so that no gap of
    the dynamics counts as a wrong zero.

    Args:
        response: simulated windows.
    """
    if _errors(response).mean() <= MISFIT:
        return []
    found: list[tuple[float, Pair, np.ndarray]] = []
    one, runs = np.zeros(len(response.starts), int), response.log.run[response.starts]
    for pair in (pair for pair in response.log.pairs if pair.angle):
        for groups, change in ((one, np.inf), (runs, ZERO_CHANGE)):
            shifts = _confirmed(response, pair, groups, _shifts(response, pair, groups, change))
            shifted = _shifted(response, pair, shifts)
            if not shifts.any() or unexplained(shifted) >= ZERO_EXPLAINED:
                continue
            cost = float(_errors(shifted).sum())
            if groups is runs:  # several parts have to be clearly better than one shift
                changes = len(_equal(shifts, runs)) - len(np.unique(runs))
                cost = cost / ZERO_BETTER + ZERO_CHANGE * changes
            found.append((cost, pair, shifts))
    if not found:
        return []
    _, pair, shifts = min(found, key=lambda each: each[0])
    both = (response, _shifted(response, pair, shifts))
    plain, left = (unexplained(each, shifts != 0.0) for each in both)
    if left >= BETTER * plain:  # gains and friction of the whole log explain these parts as well
        return []
    return [_finding(response, pair, shifts, plain, left)]


def _confirmed(response: Response, pair: Pair, groups: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """The shifts (W,) without those of parts that gains, friction and constant forces explain nearly as well.

    These are fitted to the part alone, so that a force that begins there is no shift. Only where the angle jumps as
    well, otherwise than its velocity says, are they fitted to all parts together.
    """
    confirmed, shifted = shifts.copy(), _shifted(response, pair, shifts)
    for part in _equal(shifts, groups):
        if shifts[part.start] == 0.0:
            continue
        mask = np.zeros(len(shifts), bool)
        mask[part] = True
        if _jumps(response, pair, part, groups, shifts):
            plain, left = (unexplained(each, mask) for each in (response, shifted))
        else:
            own = replace(response, starts=response.starts[part], states=response.states[part])
            plain, left = (unexplained(each) for each in (own, _shifted(own, pair, shifts[part])))
        if left >= BETTER * plain or plain - left <= 0.1:
            confirmed[part] = 0.0
    return confirmed


def _jumps(response: Response, pair: Pair, part: slice, groups: np.ndarray, shifts: np.ndarray) -> bool:
    """Whether the angle jumps by about the change of the shift at the beginning of a part, beyond what it moves."""
    if part.start == 0 or groups[part.start - 1] != groups[part.start]:
        return False
    log, change = response.log, shifts[part.start] - shifts[part.start - 1]
    rows = slice(int(response.starts[part.start - 1]), int(response.starts[part.start]) + response.horizon)
    moved = log.following[rows, pair.position] - log.observation[rows, pair.position]
    integral = 0.5 * log.dt * (log.following[rows, pair.velocity] + log.observation[rows, pair.velocity])
    return bool(abs((moved - integral).sum() + change) < 0.3 * abs(change))


def _finding(response: Response, pair: Pair, shifts: np.ndarray, plain: float, left: float) -> Finding:
    parts = list(_parts(response, shifts))
    explained = (
        f"with any gains and friction the simulator leaves {percent(plain)} of the accelerations unexplained, and "
        f"{percent(left)} "
    )
    if len({round(shift, 1) for _, shift in parts}) == 1:
        shift = parts[0][1]
        half = ", half a turn" if abs(abs(shift) - np.pi) < 0.1 else ""
        words = f"{explained}if the zero of {pair.name} is shifted by {-shift:.2f} rad{half}"
        remedy = f"if the log counts this angle from elsewhere, add offset: {shift:.4g} to its column; if the robot is "
        remedy += "mounted otherwise than in the model, turn the model"
        return Finding(CHECK, "severe", words, None, remedy)
    mask = np.zeros(len(response.log), bool)
    for rows, shift in parts:
        mask[rows] = shift != 0.0
    shifted = [(rows, shift) for rows, shift in parts if shift != 0.0]
    sizes = ", ".join(f"{-shift:.2f} rad in about rows {rows.start} to {rows.stop - 1}" for rows, shift in shifted)
    words = f"{explained}if the zero of {pair.name} is shifted by {sizes}: its sensor slipped, lost counts, or was set "
    words += "to zero elsewhere"
    remedy = "leave these rows out, or correct the column"
    return Finding(CHECK, "severe", words, Rows.of(mask), remedy)


def _parts(response: Response, shifts: np.ndarray) -> Iterator[tuple[slice, float]]:
    """Rows and shift of each part of the log; a part begins with its first window, or with its run."""
    starts, runs = response.starts, response.log.run[response.starts]
    of_run = {int(response.log.run[rows.start]): rows for rows in response.log.runs}
    for part in _equal(shifts, runs):
        run, first, after = int(runs[part.start]), part.start, part.stop
        begins = first == 0 or runs[first - 1] != run
        ends = after == len(runs) or runs[after] != run
        rows = of_run[run]
        yield (
            slice(rows.start if begins else int(starts[first]), rows.stop if ends else int(starts[after])),
            shifts[first],
        )


def _shifts(response: Response, pair: Pair, groups: np.ndarray, change: float) -> np.ndarray:
    """The shift of the angle in each window, in rad, (W,); 0 where none of at least ``zero_severe`` helps.

    Args:
        response: simulated windows.
        pair: the angle.
        groups: group of each window, (W,); the shift may change freely between groups.
        change: cost of a change within a group.
    """
    shifts = np.zeros(len(groups))
    for turn, (step, half_width) in enumerate(_GRIDS):
        grid = np.radians(np.arange(-half_width + (step if turn == 0 else 0.0), half_width + 0.5 * step, step))
        if turn == 0:
            some = np.isin(response.starts, response.thinned(_COARSE).starts)  # spares most angles the other windows
            coarse = replace(response, starts=response.starts[some], states=response.states[some])
            if not _coarse_shifts(coarse, pair, groups[some], grid, change).any():
                return shifts
            shifts = _coarse_shifts(response, pair, groups, grid, change)
        else:
            errors = _errors_of(response, pair, [shifts + shift for shift in grid])
            for part in _equal(shifts, groups):
                shifts[part] += grid[errors[:, part].mean(1).argmin()]
        if not shifts.any():
            return shifts
    fewest = max(_FEWEST, _SMALLEST * len(shifts))
    for part in reversed(_equal(shifts, groups)):
        lasts = part.stop == len(shifts) or groups[part.stop] != groups[part.start] or shifts[part.stop] != 0.0
        if not lasts or part.stop - part.start < fewest or abs(shifts[part.start]) < ZERO_SEVERE:
            shifts[part] = 0.0
    return shifts


def _coarse_shifts(response: Response, pair: Pair, groups: np.ndarray, grid: np.ndarray, change: float) -> np.ndarray:
    """The shift of a grid (K,) in each window that leaves the least error, (W,)."""
    errors = _errors_of(response, pair, [np.full(len(groups), shift) for shift in grid])
    return grid[_viterbi(errors + ZERO_GAIN * (grid != 0.0)[:, None], groups, change)]


def _errors_of(response: Response, pair: Pair, shifts: list[np.ndarray]) -> np.ndarray:
    """:func:`_errors` with each of some shifts (W,), (K, W)."""
    return np.stack([_errors(_shifted(response, pair, each)) for each in shifts])


def _viterbi(errors: np.ndarray, groups: np.ndarray, change: float) -> np.ndarray:
    """The cheapest choice of a row of ``errors`` (K, W) for each column, (W,).

    A change of the row within a group costs ``change``.
    This is the algorithm of Viterbi (1967), IEEE Transactions on Information Theory 13, 260.
    """
    cost, before = errors[:, 0], np.zeros(errors.shape, int)
    for window in range(1, errors.shape[1]):
        cheapest = int(cost.argmin())
        limit = cost.min() + (change if groups[window] == groups[window - 1] else 0.0)
        before[:, window] = np.where(cost <= limit, np.arange(len(cost)), cheapest)
        cost = np.minimum(cost, limit) + errors[:, window]
    chosen = [int(cost.argmin())]
    for window in range(errors.shape[1] - 1, 0, -1):
        chosen.append(int(before[chosen[-1], window]))
    return np.array(chosen[::-1])


def _equal(shifts: np.ndarray, groups: np.ndarray) -> list[slice]:
    """Successive windows of one group with one shift."""
    edges = np.flatnonzero((np.diff(shifts) != 0.0) | (np.diff(groups) != 0)) + 1
    return [slice(int(a), int(b)) for a, b in zip([0, *edges], [*edges, len(groups)], strict=True)]


def _shifted(response: Response, pair: Pair, shifts: np.ndarray) -> Response:
    """The windows with shifts (W,) of an angle at their beginnings; velocities do not change."""
    states = response.states.copy()
    states[:, pair.coordinate] += shifts
    return replace(response, states=states)


def _errors(response: Response) -> np.ndarray:
    """Unexplained change of the velocities of each window, in usual changes, at most 3, mean over velocities, (W,)."""
    share = np.abs(response.change - response.simulated_with(response.limited[response.rows])) / response.scale
    return np.minimum(np.where(np.isfinite(share), share, 3.0), 3.0).mean(1)


def check_small_zeros(response: Response) -> list[Finding]:
    """Angles whose zero is shifted a little: fitted beside gains and friction, then confirmed by simulation."""
    pairs = response.log.pairs
    angles = [index for index, pair in enumerate(pairs) if pair.angle]
    if not angles:
        return []
    others = friction_responses(response, constant=False)
    responses = np.concatenate([response.by_zero[..., angles], response.by_gain, others], -1)
    found = robust_fit(response.target, responses, response.scale)
    findings = []
    misfit = response.misfit()
    for place, index in enumerate(angles):
        shift, error = found.values[place], found.errors[place]
        if abs(shift) < max(ZERO_WARNING, SIGNIFICANCE * error) or abs(shift) > np.pi:
            continue
        pair = pairs[index]
        left = _shifted(response, pair, np.full(len(response.starts), shift)).misfit()
        if left < min(ZERO_BETTER * misfit, FOREIGN):
            words = f"the simulator leaves {percent(misfit)} of the accelerations unexplained, and {percent(left)} "
            words += f"if the zero of {pair.name} is shifted by {-shift:.2f} rad: an offset, or a tilted model"
            remedy = f"measure the angle's zero, for example at rest; offset: {shift:.3g} in its column corrects it"
            findings.append(Finding(CHECK, "warning", words, None, remedy))
    return findings
