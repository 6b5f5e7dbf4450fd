"""How far ahead to look for what is missing: far enough that it stands out of the sensors' noise, and no farther."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.significance import BLOCKS

_HORIZONS = (1, 5, 20)  # control steps
_FEWEST = 60  # windows, and no more are looked at
_FOLLOWED = 60  # entries
_CLEAR = 0.5  # share of the loss that one entry promises to take away: no need to look farther
_WORTH = 1.3  # times the promise of the shorter horizon: a longer one costs more, and drowns in what contacts amplify


def choose_horizon(
    simulation: Simulation, measured: Measured, catalogue: Sequence[CatalogueEntry], rng: np.random.Generator
) -> int:
    """The horizon of windows, in control steps, at which the best entry of a catalogue explains most.

    One step is enough where sensors are good. Where they are not, what is missing adds up over a window, and the noise
    of its start does not.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: what may be missing.
        rng: draws the windows that are looked at.

    Returns:
        1, 5 or 20.
    """
    chosen, most = 1, 0.0
    sensor_std = None
    for horizon in _HORIZONS:
        starts = measured.fitted(horizon)
        if horizon > 1 and (len(starts) < _FEWEST or len(measured.judged(horizon)) < BLOCKS):
            break
        problem = Problem.pose(simulation, measured, horizon, sensor_std=sensor_std)
        sensor_std = problem.sensor_std
        few = np.sort(rng.choice(starts, min(len(starts), _FEWEST), replace=False))
        leads = screen(problem, (), catalogue, few)
        # farther ahead, look only at what promises something, in the direction in which it does
        catalogue = [replace(lead.entry, trials=(dict(lead.trial),)) for lead in leads[:_FOLLOWED]]
        promise = leads[0].promise if leads else 0.0
        if horizon == 1 or promise > _WORTH * most:
            chosen, most = horizon, promise
        if most > _CLEAR:
            break
    return chosen
