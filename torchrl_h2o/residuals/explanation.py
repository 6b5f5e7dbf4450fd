"""An explanation of a residual: the effects that account for it, with their values and intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from torchrl_h2o.effects import ActionNoise, Effect
from torchrl_h2o.residuals.trace.outcome import Trace


@dataclass(frozen=True, eq=False)
class Part:
    """One effect of an explanation.

    Args:
        effect: the effect with its fitted values.
        declared: True if it is an entry of the catalogue.
        ci95: 95 % interval (low, high) of each fitted parameter, in its unit.
        alike: alternatives that explain the data equally well in place of this effect.
    """

    effect: Effect
    declared: bool
    ci95: Mapping[str, tuple[float, float]]
    alike: tuple[Effect, ...] = ()


@dataclass(frozen=True, eq=False)
class Explanation:
    """The effects that explain a residual.

    Args:
        parts: the effects in the order of their composition; empty if nothing is missing.
        trace: the search over the catalogue.
        failures: attempts that failed with an error, and why.
        ended_in: stage in which the time for the search was up, or which did not begin for that; None if all ended.
    """

    parts: tuple[Part, ...]
    trace: Trace
    failures: tuple[str, ...] = ()
    ended_in: str | None = None

    @classmethod
    def of(cls, trace: Trace) -> Explanation:
        """The explanation by effects of the catalogue alone."""
        parts = (
            Part(effect, True, trace.fit.ci95(index), tuple(attempt.effect for attempt in trace.groups[index]))
            for index, effect in enumerate(trace.fit.effects)
        )
        return cls(tuple(parts), trace, ended_in=trace.ended_in)

    def with_failure(self, failure: str) -> Explanation:
        """The explanation with a further attempt that failed."""
        return replace(self, failures=(*self.failures, failure))

    def with_parts(self, parts: Iterable[Part]) -> Explanation:
        """The explanation with other parts."""
        return replace(self, parts=tuple(parts))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects with their fitted values."""
        return tuple(part.effect for part in self.parts)


def adds_noise(effect: Effect) -> bool:
    """Whether an effect adds random noise to the actions; a random draw of it does not improve a prediction."""
    return isinstance(effect, ActionNoise) and effect.std > 0.0
