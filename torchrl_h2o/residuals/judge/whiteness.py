"""Autocorrelation of the held-out residual: about zero if white, positive if the simulator lacks an effect."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.simulation.simulation import Simulation

ROUNDING = 1e-5  # residual, in spreads of the one-step change, below which no autocorrelation is computed
# that size if some coordinates are unobserved, because the errors of their estimates last for several steps
ROUNDING_UNOBSERVED = 1e-3


def autocorrelation(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Rank correlation of successive held-out one-step residuals, (n).

    About 0 for white residuals. Sensor noise makes it negative, down to -0.5, because each reading enters two
    successive residuals with opposite signs. Remaining errors of the simulator make it positive.

    Args:
        simulation: the simulator.
        measured: the data.

    Returns:
        Spearman's correlation, because single contacts do not dominate ranks; NaN if the residual is within rounding.
    """
    rows = measured.windows(2, split=Split.REPORT)
    first, second = (residuals(simulation, measured, rows + later)[:, 0] for later in (0, 1))
    change = (measured.following - measured.observation)[measured.usable & (measured.split == Split.FIT)]
    rounding = ROUNDING_UNOBSERVED if simulation.state_map.hidden else ROUNDING
    least = rounding * np.maximum(change.std(0), 1e-12)
    left = np.abs(first).mean(0) > least if len(rows) > 1 else np.zeros(first.shape[1], bool)
    return np.array(
        [
            np.corrcoef(rankdata(a), rankdata(b))[0, 1] if some else np.nan
            for a, b, some in zip(first.T, second.T, left, strict=True)
        ]
    )
