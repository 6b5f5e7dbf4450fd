"""Describes which data would distinguish equivalent effects: data where their predictions differ most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import rankdata

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.words import number, quantity
from torchrl_h2o.residuals.simulation.simulation import Simulation

# share of the transitions, those with the largest differences of the predictions, that are described
DESCRIBED_SHARE = 0.05
NEGLIGIBLE = 1e-6  # difference of predictions, in spreads, below which they count as equal
UNUSUAL_FACTOR = 1.5  # factor by which a coordinate must differ from its usual size to be named in the description


def separated_by(
    simulation: Simulation,
    measured: Measured,
    effects: Sequence[Effect],
    before: Sequence[Effect] = (),
    after: Sequence[Effect] = (),
) -> str:
    """Describes which data would distinguish the first of some effects from the others.

    Args:
        simulation: the simulator without any of them.
        measured: the data.
        effects: alternatives, each at its best fit.
        before: effects that precede each alternative.
        after: effects that follow it.

    Returns:
        A clause with the dimension in which the predictions differ most, the difference per step, and the states or
        actions at which they differ.
    """
    simulations = [simulation.with_effects(*before, effect, *after) for effect in effects]
    return difference_between(simulations, measured)


def difference_between(simulations: Sequence[Simulation], measured: Measured) -> str:
    """Describes which data would distinguish the first of some simulations from the others, as :func:`separated_by`.

    Args:
        simulations: simulators with alternative effects.
        measured: the data.
    """
    rows = measured.windows(1)
    of_first, *of_others = (residuals(each, measured, rows)[:, 0] for each in simulations)
    simulation = simulations[0]
    spread = measured.observation.std(0) + 1e-12
    difference = np.nan_to_num(np.max([np.abs(of_first - other) for other in of_others], axis=0) / spread)
    size = difference.max(1)
    most = np.argsort(size)[-max(1, round(DESCRIBED_SHARE * len(size))) :]
    if size[most].mean() < NEGLIGIBLE:
        return "a direct measurement of one of the quantities, because the predictions for these sensors are equal"
    dimension = int(difference[most].mean(0).argmax())
    name, unit = simulation.state_map.names[dimension], simulation.state_map.units[dimension]
    by = difference[most, dimension].mean() * spread[dimension]
    where = where_it_is_large(simulation, measured, rows, size, most, UNUSUAL_FACTOR)
    return (
        f"more data{where}, because the predictions differ most in {name}, by {quantity(by, unit, 2)} per step; or a "
        "direct measurement of one of the quantities"
    )


def where_it_is_large(
    simulation: Simulation,
    measured: Measured,
    rows: np.ndarray,
    size: np.ndarray,
    most: np.ndarray,
    factor: float,
) -> str:
    """Clause that names the state or action at which the predictions differ; empty if no coordinate is unusual there.

    Args:
        simulation: the simulator, for names and units.
        measured: the data.
        rows: (W), all transitions.
        size: (W), difference of the predictions.
        most: indices of the transitions where it is largest.
        factor: factor by which the coordinate must differ from its usual size there.
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
    if usual / factor < typical < usual * factor:
        return ""
    side = "large" if typical > usual else "small"
    return f" where {names[best]} is {side} (about ±{quantity(typical, units[best], 2)}, usually ±{number(usual, 2)})"
