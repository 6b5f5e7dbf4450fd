"""What would tell effects apart that the data at hand cannot: where what they predict differs most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import rankdata

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.report.words import number, quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation

_NOTHING = 1e-6  # of a dimension's spread: a difference that no data would show
_MOST = 0.05  # of the transitions: where predictions differ most
_TELLING = 1.5  # times the usual size of a coordinate, or one in as many: that says where


def separated_by(
    simulation: Simulation,
    measured: Measured,
    effects: Sequence[Effect],
    before: Sequence[Effect] = (),
    behind: Sequence[Effect] = (),
) -> str:
    """Which data would tell the first of some effects from the others.

    Args:
        simulation: without any of them.
        measured: the data.
        effects: alternatives, each at its best fit.
        before: effects that are in beside each of them, and come before it.
        behind: the same, and come behind it.

    Returns:
        In words: the dimension in which their predictions differ most, by how much, and at which states or actions.
    """
    rows = measured.windows(1)
    of_first, *of_others = (
        residuals(simulation.with_effects(*before, effect, *behind), measured, rows)[:, 0] for effect in effects
    )
    spread = measured.observation.std(0) + 1e-12
    difference = np.nan_to_num(np.max([np.abs(of_first - other) for other in of_others], axis=0) / spread)
    size = difference.max(1)
    most = np.argsort(size)[-max(1, round(_MOST * len(size))) :]
    if size[most].mean() < _NOTHING:
        return "nothing that these sensors read: their predictions are the same; measure one of them by itself"
    dimension = int(difference[most].mean(0).argmax())
    name, unit = simulation.state_map.names[dimension], simulation.state_map.units[dimension]
    by = difference[most, dimension].mean() * spread[dimension]
    where = _where(simulation, measured, rows, size, most)
    return (
        f"their predictions differ most in {name}, by {quantity(by, unit, 2)} a step{where}; more such data, or "
        "measuring one of them by itself, would tell them apart"
    )


def _where(simulation: Simulation, measured: Measured, rows: np.ndarray, size: np.ndarray, most: np.ndarray) -> str:
    """At which state or action, in words; nothing where no single one tells."""
    coordinates = np.abs(np.hstack([measured.observation[rows], measured.action[rows]]))
    names = [*simulation.state_map.names, *(f"the action of actuator {name}" for name in simulation.actuators)]
    units = [*simulation.state_map.units, *("1" for _ in simulation.actuators)]
    moving = coordinates.std(0) > 0.0
    ranks, size_ranks = rankdata(coordinates[:, moving], axis=0), rankdata(size)
    telling = np.zeros(len(names))
    telling[moving] = [np.corrcoef(rank, size_ranks)[0, 1] for rank in ranks.T]
    best = int(np.abs(telling).argmax())
    typical, usual = (float(np.median(coordinates[which, best])) for which in (most, slice(None)))
    if usual / _TELLING < typical < usual * _TELLING:
        return ""
    side = "large" if typical > usual else "small"
    return f", where {names[best]} is {side} (about ±{quantity(typical, units[best], 2)}, usually ±{number(usual, 2)})"
