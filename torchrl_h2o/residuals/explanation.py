"""An explanation of a residual: the effects that account for it, with their values and intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from torchrl_h2o.effects import ActionNoise, CatalogueEntry, Effect
from torchrl_h2o.residuals.between_logs import InLogs
from torchrl_h2o.residuals.report.contents import SearchStep

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Alternative:
    """An effect that explains the data as well as one that was found, with the others readjusted.

    Args:
        effect: the effect.
        together: all effects with this one in the other's place, each with its intervals.
    """

    effect: Effect
    together: tuple[tuple[Effect, Mapping[str, Interval]], ...]


@dataclass(frozen=True, eq=False)
class Part:
    """One effect of an explanation.

    Args:
        effect: the effect with its fitted values.
        declared: True if it is an entry of the catalogue.
        ci95: 95 % interval (low, high) of each fitted parameter, in its unit.
        alike: alternatives that explain the data equally well in place of this effect.
        in_logs: each fitted parameter in each of several logs.
    """

    effect: Effect
    declared: bool
    ci95: Mapping[str, Interval]
    alike: tuple[Alternative, ...] = ()
    in_logs: Mapping[str, InLogs] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Tried:
    """An effect that was fitted beside those found, but not put in.

    Args:
        entry: entry of the catalogue.
        effect: the effect at its best fit.
        evidence: evidence of the rows for fits and for selection that it adds to the others, in nats.
    """

    entry: CatalogueEntry
    effect: Effect
    evidence: float

    @property
    def p_value(self) -> float:
        """Inverse of the likelihood ratio, which bounds the p-value of this evidence; at most 1."""
        return math.exp(-max(self.evidence, 0.0))


@dataclass(frozen=True, eq=False)
class Explanation:
    """The effects that explain a residual.

    Args:
        parts: the effects in the order of their composition; empty if nothing is missing.
        tried: effects that were not put in, those of the most evidence first.
        others: other sets of effects that explain the data as well, with more than one other effect.
        unseen: effects of a usual size that the data could not have shown; only where nothing was found.
        steps: the sets that the search passed through, in order, with what each gained.
        failures: attempts that failed with an error, and why.
        ended_in: stage in which the time for the search was up, or which did not begin for that; None if all ended.
    """

    parts: tuple[Part, ...]
    tried: tuple[Tried, ...] = ()
    others: tuple[tuple[Effect, ...], ...] = ()
    unseen: tuple[Effect, ...] = ()
    steps: tuple[SearchStep, ...] = ()
    failures: tuple[str, ...] = ()
    ended_in: str | None = None

    def with_failure(self, failure: str) -> Explanation:
        """The explanation with a further attempt that failed."""
        return replace(self, failures=(*self.failures, failure))

    def with_parts(self, parts: Iterable[Part]) -> Explanation:
        """The explanation with other parts."""
        return replace(self, parts=tuple(parts))

    def beside(self, part: Part) -> Explanation:
        """The explanation with a further part, which stands in all alternatives, too."""

        def both(other: Alternative) -> Alternative:
            return replace(other, together=(*other.together, (part.effect, part.ci95)))

        parts = [replace(one, alike=tuple(map(both, one.alike))) for one in self.parts]
        others = tuple((*effects, part.effect) for effects in self.others)
        return replace(self, parts=(*parts, part), others=others)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects with their fitted values."""
        return tuple(part.effect for part in self.parts)


def adds_noise(effect: Effect) -> bool:
    """Whether an effect adds random noise to the actions; a random draw of it does not improve a prediction."""
    return isinstance(effect, ActionNoise) and effect.std > 0.0
