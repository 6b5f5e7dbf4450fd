"""The entries of the catalogue that a search tries on given data."""

from __future__ import annotations

from torchrl_h2o.data.audit.derivative import fit_derivative
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.effects import CatalogueEntry, ObservationDelay
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation


def offered_entries(simulation: Simulation, measured: Measured) -> tuple[CatalogueEntry, ...]:
    """Returns the catalogue of a simulator; with a delay of the velocities only if the data alone show it.

    Undoing a delay of some sensors averages neighbouring rows. This also lowers the residual of a noisy process, so the
    held-out loss does not tell whether there is such a delay. The positions do: their derivative is then early.

    Args:
        simulation: the simulator.
        measured: the data.
    """
    entries = simulation.catalogue()
    return entries if velocities_are_late(simulation, measured) else tuple(e for e in entries if not _is_partial(e))


def velocities_are_late(simulation: Simulation, measured: Measured) -> bool:
    """Whether a velocity is late against the derivative of its position, by more than half a row."""
    log = Log.of(measured, simulation)
    return any(fit_derivative(log, pair).lag > 0.5 for pair in log.pairs)


def _is_partial(entry: CatalogueEntry) -> bool:
    return isinstance(entry.effect, ObservationDelay) and entry.effect.entries is not None
