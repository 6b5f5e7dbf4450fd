"""Chooses the window length of the search: the shortest at which missing effects exceed the sensors' noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen


def choose_horizon(
    simulation: Simulation,
    measured: Measured,
    catalogue: Sequence[CatalogueEntry],
    rng: np.random.Generator,
    settings: LoopSettings = DEFAULTS,
) -> int:
    """Chooses how many control steps each window of the search has.

    With good sensors one step is enough. With noisy sensors a longer window helps: the error from a missing effect
    accumulates over the window, but the noise of the start state does not.

    Args:
        simulation: the simulator.
        measured: the data.
        catalogue: entries that may be missing.
        rng: generator for the choice of the screened windows.
        settings: lengths to choose from, and thresholds.

    Returns:
        One of ``settings.horizon.horizons``.
    """
    rules, blocks = settings.horizon, settings.significance.blocks
    shortest = rules.horizons[0]
    chosen, most = shortest, 0.0
    sensor_std = None
    for horizon in rules.horizons:
        starts = measured.fitted(horizon)
        if horizon != shortest and (len(starts) < rules.windows or len(measured.judged(horizon)) < blocks):
            break
        problem = Problem.pose(simulation, measured, horizon, sensor_std=sensor_std, settings=settings.residual)
        sensor_std = problem.sensor_std
        few = np.sort(rng.choice(starts, min(len(starts), rules.windows), replace=False))
        leads = screen(problem, (), catalogue, few)
        # at longer windows only the most promising entries are screened, each with its best trial
        catalogue = [replace(lead.entry, trials=(dict(lead.trial),)) for lead in leads[: rules.entries_followed]]
        promise = leads[0].promise if leads else 0.0
        if horizon == shortest or promise > rules.longer_gain * most:
            chosen, most = horizon, promise
        if most > rules.clear_promise:
            break
    return chosen
