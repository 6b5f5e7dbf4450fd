"""Blocks of neighbouring rows: predictions start inside them, and explanations are compared block by block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from torchrl_h2o.residuals.measured.transitions import Measured, Split

SECONDS = 0.3  # time that a prediction looks ahead, rounded to a power of two of control steps
LEAST_STEPS, MOST_STEPS = 16, 128  # control steps of a block, if the runs are long enough
FEWEST_BLOCKS = 12  # blocks of the rows for selection below which shorter blocks are cut
LENGTHS = (2, 8)  # control steps of the short windows; the longest are whole blocks
SHORTEST = 4  # control steps of the shortest blocks, for runs of a few rows


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of one length that start inside blocks.

    Args:
        rows: (W), first row of each window.
        block: (W), index of its block.
        offset: (W), rows from the beginning of its block.
        steps: control steps of each window.
        horizons: control steps ahead at which a prediction is compared with the data, (h).
    """

    rows: np.ndarray
    block: np.ndarray
    offset: np.ndarray
    steps: int
    horizons: np.ndarray

    @property
    def all_rows(self) -> np.ndarray:
        """Rows of every window, (W, steps)."""
        return self.rows[:, None] + np.arange(self.steps)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of neighbouring usable rows, each of one run and of one part of the data.

    Args:
        first: (B), first row of each block.
        steps: rows of each block, a power of two.
        lengths: control steps of the shorter windows.
    """

    first: np.ndarray
    steps: int
    lengths: tuple[int, ...] = LENGTHS

    @classmethod
    def of(cls, measured: Measured, splits: Split | tuple[Split, ...], steps: int, most_rows: int) -> Blocks:
        """Cuts parts of the data into blocks, evenly thinned to at most ``most_rows`` rows."""
        parts = splits if isinstance(splits, tuple) else (splits,)
        good = measured.usable & np.isin(measured.split, parts)
        key = np.where(good, len(Split) * measured.run + measured.split, -1)
        edges = [0, *(np.flatnonzero(np.diff(key)) + 1), len(key)]
        first = [
            row for start, stop in pairwise(edges) if key[start] >= 0 for row in range(start, stop - steps + 1, steps)
        ]
        most = max(1, most_rows // steps)
        if len(first) > most:
            first = [first[i] for i in np.unique(np.linspace(0, len(first) - 1, most).round().astype(int))]
        return cls(np.array(first, int), steps)

    def __len__(self) -> int:
        return len(self.first)

    @property
    def rows(self) -> np.ndarray:
        """All rows of the blocks, (B, steps)."""
        return self.first[:, None] + np.arange(self.steps)

    @property
    def num_horizons(self) -> int:
        """Number of horizons of all windows."""
        return sum(len(windows.horizons) for windows in self.windows)

    @cached_property
    def windows(self) -> tuple[Windows, ...]:
        """Windows of a few lengths, each kind one after another, with horizons that are powers of two."""
        found, least = [], 1
        for steps in (*(length for length in self.lengths if length < self.steps), self.steps):
            offsets = np.arange(0, self.steps, steps)
            found.append(
                Windows(
                    (self.first[:, None] + offsets).ravel(),
                    np.repeat(np.arange(len(self)), len(offsets)),
                    np.tile(offsets, len(self)),
                    steps,
                    2 ** np.arange(round(math.log2(least)), round(math.log2(steps)) + 1),
                )
            )
            least = 2 * steps
        return tuple(found)


def block_steps(measured: Measured, control_step: float) -> int:
    """Control steps of the blocks into which data are cut: about ``SECONDS``, shorter where the runs are short."""
    steps = int(np.clip(2 ** round(math.log2(SECONDS / control_step)), LEAST_STEPS, MOST_STEPS))
    while steps > SHORTEST and len(Blocks.of(measured, Split.SELECTION, steps, len(measured))) < FEWEST_BLOCKS:
        steps //= 2
    return steps
