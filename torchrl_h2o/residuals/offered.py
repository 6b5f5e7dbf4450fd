"""What a search tries on given data: the catalogue, but for late velocities, which are read off the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.audit.derivative import fit_derivative
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.effects import CatalogueEntry, ObservationDelay
from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.intervals import interval
from torchrl_h2o.residuals.measured.begun_anew import begun_anew
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

LATE = 0.5  # rows by which a velocity is late against the derivative of its position if a filter computed it
LAG_ERROR = 0.5  # rows by which this lag is uncertain at least


def offered_entries(simulation: Simulation) -> tuple[CatalogueEntry, ...]:
    """The catalogue of a simulator without delays of sensors.

    All sensors late by one time give the same log as all motors late by it. For delays of some
    sensors, see :func:`late_velocities`.
    """
    return tuple(entry for entry in simulation.catalogue() if not isinstance(entry.effect, ObservationDelay))


def late_velocities(simulation: Simulation, measured: Measured) -> tuple[Part | None, Measured]:
    """A delay of the velocities that are late against their positions, and the data in which they say nothing new.

    A filter computed such velocities from the positions. Errors of successive rows are then alike, and no effect of the
    machine explains them.

    Args:
        simulation: the simulator.
        measured: the data.

    Returns:
        The delay, None without one, and the data with these columns as ones that were estimated from others.
    """
    log, step = Log.of(measured, simulation), simulation.control_step
    log = replace(log, clipped=log.clipped | begun_anew(log))
    late = [found for found in (fit_derivative(log, pair) for pair in log.pairs) if found.lag > LATE]
    if not late:
        return None, measured
    known = simulation.pipeline.of_kind(ObservationDelay)
    lags = [
        found.lag - (_delay(known, found.pair.velocity) - _delay(known, found.pair.position)) / step for found in late
    ]
    rows, half = float(np.mean(lags)), max(LAG_ERROR, float(np.ptp(lags)) / 2.0)
    std = np.zeros(len(log.names)) if measured.estimated_std is None else measured.estimated_std.copy()
    columns = tuple(sorted(found.pair.velocity for found in late))
    std[list(columns)] = [max(found.velocity_noise, 1e-12) for found in sorted(late, key=lambda one: one.pair.velocity)]
    measured = replace(measured, estimated_std=std)
    if rows <= LATE:  # the simulator has this delay
        return None, measured
    most = ObservationDelay().parameters["delay"].bounds[1]
    delay = ObservationDelay(min(step * rows, most), columns)
    return Part(delay, True, {"delay": interval(delay.parameters["delay"], step * half)}), measured


def _delay(effects: Sequence[ObservationDelay], column: int) -> float:
    """Delay of a column by some effects, in s."""
    return sum(effect.delay for effect in effects if effect.entries is None or column in effect.entries)
