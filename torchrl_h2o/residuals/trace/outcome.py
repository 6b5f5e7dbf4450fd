"""Result of the search for effects: the effects found, the other effects tried, and equivalent alternatives."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.effects.catalogue.plausibility import surprise
from torchrl_h2o.residuals.trace.fit import Fit


@dataclass(frozen=True, eq=False)
class Attempt:
    """A catalogue entry that was fitted together with the other effects.

    Args:
        entry: entry of the catalogue.
        fit: joint fit of this entry and the other effects.
        index: position of this entry's effect in the fit.
        loss: mean robust loss on held-out windows.
        p_value: p-value of its gain, or of its loss difference from the effect that it replaces.
    """

    entry: CatalogueEntry
    fit: Fit
    index: int
    loss: float
    p_value: float

    @property
    def effect(self) -> Effect:
        """The entry's effect at its fitted values."""
        return self.fit.effects[self.index]


class Question(NamedTuple):
    """Key of a search for alternatives: the effect, all effects found, and whether only rounding remains.

    Args:
        name: name of the effect's entry.
        beside: names of the entries of all effects found.
        exact: whether these leave only rounding.
    """

    name: str
    beside: frozenset[str]
    exact: bool


@dataclass(frozen=True, eq=False)
class RivalSet:
    """A set of effects that explains the data as well as the one found.

    Args:
        entries: entries of the catalogue.
        fit: their joint fit.
        loss: mean loss on the windows by which effects are chosen.
    """

    entries: tuple[CatalogueEntry, ...]
    fit: Fit
    loss: float

    @property
    def surprise(self) -> int:
        """How unusual its effects are, see :func:`~torchrl_h2o.effects.catalogue.plausibility.surprise`."""
        return sum(map(surprise, self.fit.effects))


@dataclass(frozen=True, eq=False)
class Trace:
    """Result of a search over a catalogue.

    Args:
        entries: entries of the effects found, in the order in which they were added.
        fit: joint fit of these effects.
        attempts: other entries that were fitted, in ascending order of their loss.
        groups: for each effect found, alternatives with an equivalent loss, in ascending order of their loss.
        exact: True if the remaining residual is within the rounding of single-precision data.
        others: other sets of effects with an equivalent loss, the most usual ones first.
        horizon: control steps per window that were chosen for the data.
        ended_in: stage in which the time for the search was up; None if it came to its end.
        loss: where nothing was found, the mean robust loss on held-out windows without the attempts; else NaN.
        by_forces: whether the effects are those of a regression of the missing forces, because torques are so noisy
            that the motion does not show them.
    """

    entries: tuple[CatalogueEntry, ...]
    fit: Fit
    attempts: tuple[Attempt, ...]
    groups: tuple[tuple[Attempt, ...], ...]
    exact: bool
    others: tuple[RivalSet, ...] = ()
    horizon: int = 1
    ended_in: str | None = None
    by_forces: bool = False
    loss: float = math.nan
