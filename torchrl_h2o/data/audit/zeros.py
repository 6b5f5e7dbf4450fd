"""Hypotheses about the zeros of angles: shifted in all rows, or in a part of the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.finding import Finding, Rows
from torchrl_h2o.data.audit.physics import BETTER, SMALL_ZERO, Explained, explain
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.rival import Rival, leaves

TURN_STEPS = 12  # shifts of an angle that are tried around the circle
SHORTEST_PART = 12  # windows of a part of the log with its own zero
ENTIRE = 0.95  # share of the windows from which a part is the whole log
MARGIN = 0.05  # share of a window's change that a shift must explain for the window to belong to a part

Turns = Sequence[tuple[np.ndarray, Explained]]


def turns(few: Response) -> Iterator[tuple[np.ndarray, Explained]]:
    """Shifts of one angle after another around the circle, (pairs,), and what physics explain with them."""
    pairs = few.log.pairs
    for index in np.flatnonzero([pair.angle for pair in pairs]):
        for step in range(1, TURN_STEPS):
            shifts = np.eye(len(pairs))[index] * 2.0 * np.pi * step / TURN_STEPS
            yield shifts, explain(few.shifted(shifts))


def shifted_zeros(response: Response, plain: Explained, left: Explained, tried: Turns) -> Iterator[Rival]:
    """Angles that are counted from elsewhere than in the model, in all rows.

    Args:
        response: simulated windows.
        plain: what simple physics explains of them.
        left: what they explain of the windows that were turned.
        tried: the shifts of :func:`turns`.
    """
    if not tried:
        return
    shifts, explained = min(tried, key=lambda turn: turn[1].share)
    starts = [np.zeros(len(response.log.pairs)), *([shifts] if explained.share < left.share else [])]
    for start in starts:
        if (shifts := _refined(response, start)).any():
            explained = explain(replace(response.shifted(shifts), like=None))
            found = _findings(response, plain, explained, shifts)
            severe = any(finding.severity == "severe" for finding in found)
            yield Rival(explained, plain, found, enough=BETTER if severe else 1.0)


def _refined(response: Response, shifts: np.ndarray) -> np.ndarray:
    """Shifts of the angles, (pairs,), with which simple physics explains most, near given ones; 0 for small ones."""
    angles = np.array([pair.angle for pair in response.log.pairs])
    for _ in range(3):
        explained = explain(replace(response.shifted(shifts), like=None), zeros=np.pi)
        shifts = shifts + np.where(angles, np.clip(explained.zeros.mean(0), -0.5, 0.5), 0.0)
    return np.where(np.abs(shifts) > SMALL_ZERO, np.angle(np.exp(1j * shifts)), 0.0)


def _findings(response: Response, plain: Explained, explained: Explained, shifts: np.ndarray) -> tuple[Finding, ...]:
    found = []
    for pair, shift in zip(response.log.pairs, shifts, strict=True):
        if shift:
            half = ", half a turn" if abs(abs(shift) - np.pi) < 0.1 else ""
            words = f"{leaves(plain, explained)}the zero of {pair.name} is shifted by {-shift:.2f} rad{half}: an "
            words += "offset, a tilted model, or a centre of mass beside the joint's axis"
            severity = "severe" if abs(shift) > 0.5 * np.pi else "warning"  # a load turns a joint by less
            remedy = "measure the angle's zero, for example at rest; if it is wrong, add offset: "
            found.append(Finding("model", severity, words, None, f"{remedy}{shift:.3g} to its column"))
    return tuple(found)


def slipped_zeros(
    response: Response, plain: Explained, few: Response, left: Explained, tried: Turns
) -> Iterator[Rival]:
    """An angle that is counted from elsewhere in a part of the log, as that of an encoder that loses counts.

    Physics are fitted to the part alone, so a force that begins there is no shift.

    Args:
        response: simulated windows.
        plain: what simple physics explains of them.
        few: the windows that were turned.
        left: what simple physics explains of these.
        tried: the shifts of :func:`turns`.
    """
    best = 0.0, slice(0), np.zeros(0)
    for shifts, shifted in tried:
        gained = (left.sizes - shifted.sizes).mean(1) - MARGIN
        best = max(best, (*_highest_sum(gained, few.log.run[few.starts]), shifts), key=lambda found: found[0])
    total, part, shifts = best
    if not total or not SHORTEST_PART <= part.stop - part.start < ENTIRE * len(few.starts):
        return
    first, last = few.starts[part.start], few.starts[part.stop - 1]
    inside = (response.starts >= first) & (response.starts <= last)
    own = response.at(inside)
    if len(own.starts) < SHORTEST_PART or not (shifts := _refined(own, shifts)).any():
        return
    without, explained = explain(own), explain(replace(own.shifted(shifts), like=None))
    index = int(np.abs(shifts).argmax())
    rows = np.zeros(len(response.log), bool)
    rows[first : last + response.horizon] = True
    if not explained.explains_more(without):
        return
    words = f"{leaves(without, explained)}the zero of {response.log.pairs[index].name} is shifted by "
    words += f"{-shifts[index]:.2f} rad in about rows {first} to {last}: its sensor slipped, lost counts, or was set "
    words += "to zero elsewhere"
    finding = Finding("model", "severe", words, Rows.of(rows), "leave these rows out, or correct the column")
    yield Rival(explain(response.shifted(shifts, inside)), plain, (finding,))


def _highest_sum(values: np.ndarray, groups: np.ndarray) -> tuple[float, slice]:
    """The highest sum of successive values of one group, and their places (the algorithm of Kadane)."""
    best, total, first = (0.0, slice(0)), 0.0, 0
    for place, value in enumerate(values):
        if total <= 0.0 or groups[place] != groups[place - 1]:
            total, first = 0.0, place
        total += value
        if total > best[0]:
            best = total, slice(first, place + 1)
    return best
