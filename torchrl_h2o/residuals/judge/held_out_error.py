"""Held-out errors before and after effects are put in: overall, by dimension, and several steps ahead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchrl_h2o.residuals.judge.headline import headline_error, headline_horizon
from torchrl_h2o.residuals.judge.network import learned
from torchrl_h2o.residuals.judge.whiteness import autocorrelation
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.report.errors import DimensionError, ErrorSummary, HorizonError
from torchrl_h2o.residuals.simulation.simulation import Simulation

HORIZONS = (1, 2, 5, 10, 20, 50)  # control steps ahead at which errors are reported
METRIC = "held-out one-step RMSE, each dimension divided by the standard deviation of its one-step change"


def error_summary(simulation: Simulation, mended: Simulation, measured: Measured) -> ErrorSummary:
    """Summarises the held-out errors of two simulations, without a floor and without the errors ahead.

    Args:
        simulation: the simulator before the effects are put in.
        mended: the simulator with them.
        measured: the data.
    """
    names, units = simulation.state_map.names, simulation.state_map.units
    before, after = (_rmse(which, measured, 1) for which in (simulation, mended))
    ahead = headline_horizon(simulation, measured)
    whiteness = autocorrelation(mended, measured)
    columns = zip(names, units, before.tolist(), after.tolist(), whiteness.tolist(), strict=True)
    return ErrorSummary(
        metric=METRIC,
        unit="1",
        before=overall_error(simulation, measured),
        after=overall_error(mended, measured),
        per_dimension=tuple(
            DimensionError(name, unit, first, last, autocorrelation=white) for name, unit, first, last, white in columns
        ),
        headline=None if ahead is None else headline_error(simulation, mended, measured, ahead),
    )


def with_horizons(error: ErrorSummary, simulation: Simulation, mended: Simulation, measured: Measured) -> ErrorSummary:
    """The summary with the errors several steps ahead."""
    return replace(error, horizons=_horizons(simulation, mended, measured))


def with_floor(error: ErrorSummary, mended: Simulation, measured: Measured) -> ErrorSummary:
    """The summary with the error one step ahead that the best possible model would leave, which no network learns."""
    floor = explainable_floor(mended, measured)
    per_dimension = (replace(one, floor=value) for one, value in zip(error.per_dimension, floor.tolist(), strict=True))
    overall = float(np.sqrt(np.mean((floor / spread(measured)) ** 2)))
    return replace(error, floor=overall, per_dimension=tuple(per_dimension))


def explainable_floor(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Held-out one-step RMSE that a network leaves which learns from the simulator's residuals, (n), in their units."""
    fitted, judged = measured.fitted(), measured.reported_on()
    errors, left = (residuals(simulation, measured, rows)[:, 0] for rows in (fitted, judged))
    rest = left - learned(simulation, measured, fitted, judged, errors, steps=1, seed=0)
    return np.sqrt(np.minimum(np.nanmean(rest**2, axis=0), np.nanmean(left**2, axis=0)))


def overall_error(simulation: Simulation, measured: Measured) -> float:
    """Held-out one-step RMSE over all dimensions, each in units of its :func:`spread`."""
    return float(np.sqrt(np.mean((_rmse(simulation, measured, 1) / spread(measured)) ** 2)))


def spread(measured: Measured) -> np.ndarray:
    """Standard deviation of each dimension's one-step change, (n), over the rows that are not held out."""
    change = (measured.following - measured.observation)[measured.usable & (measured.split == Split.FIT)]
    return np.maximum(change.std(0), 1e-12)


def _horizons(simulation: Simulation, mended: Simulation, measured: Measured) -> tuple[HorizonError, ...]:
    """Errors at each horizon with at least two held-out windows."""
    names, found = simulation.state_map.names, []
    for steps in HORIZONS:
        if len(measured.reported_on(steps)) < 2:
            break
        ahead = [
            dict(zip(names, _rmse(which, measured, steps).tolist(), strict=True)) for which in (simulation, mended)
        ]
        found.append(HorizonError(steps, steps * simulation.control_step, *ahead))
    return tuple(found)


def _rmse(simulation: Simulation, measured: Measured, horizon: int) -> np.ndarray:
    """Held-out RMSE at the end of windows, (n), in units of the observations."""
    starts = measured.reported_on(horizon)
    # the simulator's own action noise is drawn, because it is part of the simulator's error
    missed = residuals(simulation, measured, starts, horizon, rng=np.random.default_rng(0))[:, -1]
    return np.sqrt(np.nanmean(missed**2, axis=0))
