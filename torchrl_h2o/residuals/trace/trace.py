"""What a search for effects found, what else it tried, and what cannot be told apart."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.residuals.trace.fit import Fit


@dataclass(frozen=True, eq=False)
class Attempt:
    """An effect that was tried beside the others, and what came of it.

    Args:
        entry: of the catalogue.
        fit: of it and the others.
        index: which effect of the fit it is.
        loss: on held-out windows.
        p_value: of its gain.
    """

    entry: CatalogueEntry
    fit: Fit
    index: int
    loss: float
    p_value: float

    @property
    def effect(self) -> Effect:
        """The effect at its best fit."""
        return self.fit.effects[self.index]


@dataclass(frozen=True, eq=False)
class Trace:
    """What a search found.

    Args:
        entries: of the effects found, in the order in which they pay.
        fit: their joint fit.
        attempts: what else was tried, the best first.
        groups: for each effect found, others that do as well in its place, the best first.
        exact: whether nothing is left but that data are single precision.
    """

    entries: tuple[CatalogueEntry, ...]
    fit: Fit
    attempts: tuple[Attempt, ...]
    groups: tuple[tuple[Attempt, ...], ...]
    exact: bool
