"""The data that the search uses: measured transitions without intervals that were disturbed from outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_h2o.data.audit import Audit
from torchrl_h2o.data.audit.derivative import roughness_of
from torchrl_h2o.data.audit.log import Log, Pair
from torchrl_h2o.data.audit.response import LOST
from torchrl_h2o.residuals.measured.outside import OutsideInterval, outside_intervals, without_intervals
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

MAX_DIVERGED = 0.1  # largest share of transitions at which the simulator may diverge in one step, for example at falls


@dataclass(frozen=True, eq=False)
class Evidence:
    """A simulator and the data that it is compared with.

    Args:
        simulation: the simulator.
        measured: all transitions.
        undisturbed: the transitions without suspected disturbances, for fits.
        suspected: intervals that may have been disturbed from outside.
        audit: findings of the audit of the data; None if it was not audited.
    """

    simulation: Simulation
    measured: Measured
    undisturbed: Measured
    suspected: tuple[OutsideInterval, ...]
    audit: Audit | None = None


def why_no_conclusion(simulation: Simulation, measured: Measured) -> str | None:
    """Reason why data and simulator allow no conclusion; None if a conclusion is possible."""
    if (reason := measured.why_no_conclusion()) is not None:
        return reason
    diverged = ~np.isfinite(residuals(simulation, measured, measured.fitted())).all((1, 2))
    if diverged.mean() > MAX_DIVERGED:
        return (
            f"the simulator diverges within one step of {diverged.mean():.0%} of the measured states; check its "
            "timestep, the units, and the coordinate that each column stands for"
        )
    lost = [pair.name for pair in Log.of(measured, simulation).pairs if pair.angle and _noise(measured, pair) > LOST]
    if lost:
        return (
            f"the noise of {', '.join(lost)} exceeds {LOST:g} rad, so the sensor does not tell where the joint is, and "
            "any friction could be found; use a better sensor, or see whether the column is that angle"
        )
    return None


def _noise(measured: Measured, pair: Pair) -> float:
    """Largest noise that a position may have, by its third differences, in its unit."""
    return roughness_of(measured.observation[:, pair.position], measured.run)


def gather_evidence(simulation: Simulation, measured: Measured, *, audit: Audit | None = None) -> Evidence:
    """Excludes the intervals that may have been disturbed from outside.

    Args:
        simulation: the simulator.
        measured: the data.
        audit: findings of the audit of the data, for the report.
    """
    suspected = outside_intervals(simulation, measured)
    return Evidence(simulation, measured, without_intervals(measured, suspected), tuple(suspected), audit)
