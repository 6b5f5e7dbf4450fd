"""Names the states or actions at which something about the rows is large."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.words import number, quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation

DESCRIBED_SHARE = 0.05  # share of the rows, those where it is largest, that are described
UNUSUAL_FACTOR = 1.5  # factor by which a coordinate must differ from its usual size to be named


def where_it_is_large(
    simulation: Simulation,
    measured: Measured,
    rows: np.ndarray,
    size: np.ndarray,
    most: np.ndarray,
) -> str:
    """Clause that names the state or action at which a size is large; empty if no coordinate is unusual there.

    Args:
        simulation: the simulator, for names and units.
        measured: the data.
        rows: (W), all transitions.
        size: (W), such as errors of predictions.
        most: indices of the transitions where it is largest.
    """
    coordinates = np.abs(np.hstack([measured.observation[rows], measured.action[rows]]))
    names = [*simulation.state_map.names, *(f"the action of actuator {name}" for name in simulation.actuators)]
    units = [*simulation.state_map.units, *("1" for _ in simulation.actuators)]
    moving = coordinates.std(0) > 0.0
    ranks, size_ranks = rankdata(coordinates[:, moving], axis=0), rankdata(size)
    telling = np.zeros(len(names))
    telling[moving] = [np.corrcoef(rank, size_ranks)[0, 1] for rank in ranks.T]
    best = int(np.abs(telling).argmax())
    typical, usual = (float(np.median(coordinates[which, best])) for which in (most, slice(None)))
    if usual / UNUSUAL_FACTOR < typical < usual * UNUSUAL_FACTOR:
        return ""
    side = "large" if typical > usual else "small"
    return f" where {names[best]} is {side} (about ±{quantity(typical, units[best], 2)}, usually ±{number(usual, 2)})"
