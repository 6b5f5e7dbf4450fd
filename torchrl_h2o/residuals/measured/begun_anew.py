"""Finds transitions over which a run begins anew although the data do not mark it: nothing moves so far in one step."""

from __future__ import annotations

import numpy as np

from torchrl_h2o.data.audit.derivative import farthest, roughness
from torchrl_h2o.data.audit.log import Log

BEGUN_ANEW = "a run begins anew"  # reason for excluded rows
NOISE = 10.0  # deviations of a position's noise that it may move besides
RARE = 0.01  # share of the rows beyond which positions and velocities do not belong together, which the audit reports


def begun_anew(log: Log) -> np.ndarray:
    """Mask, (T,), of transitions whose next positions lie farther away than the largest measured velocity leads.

    Some data sets write the first observation of the next episode behind the last one of an episode. Rows at the end
    of a sensor's range, whose velocity is larger than measured, are not in the mask.
    """
    found = np.zeros(len(log), bool)
    for pair in log.pairs:
        moved = np.abs(log.following[:, pair.position] - log.observation[:, pair.position])
        found |= moved > farthest(log, pair) + NOISE * roughness(log, pair.position)
    found &= ~log.clipped
    return found if found.mean() <= RARE else np.zeros(len(log), bool)
