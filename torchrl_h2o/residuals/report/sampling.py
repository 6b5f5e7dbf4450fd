"""Draws from what a report leaves open: effects that the data cannot tell apart, and the intervals of their values."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.stats import truncnorm

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.report.contents import Fitted, Intervals, ReportContents
from torchrl_h2o.residuals.report.words import effect_name

HALF_WIDTH = 1.96  # of a 95 % interval, in standard deviations of a normal distribution


def sample(report: ReportContents, n: int, *, seed: int = 0) -> list[tuple[Effect, ...]]:
    """Draws n lists of effects; see :meth:`~torchrl_h2o.residuals.Report.sample`."""
    if n < 0:
        raise ValueError(f"n is {n}; draw at least 0 lists of effects")
    rng, explanations = np.random.default_rng(seed), explanations_of(report)
    return [
        tuple(_drawn(effect, intervals, rng) for effect, intervals in explanations[rng.integers(len(explanations))])
        for _ in range(n)
    ]


def explanations_of(report: ReportContents) -> list[Fitted]:
    """The report's explanation, one for each alternative to an effect, and one for each other set of effects.

    Two effects are never replaced at once: alternatives were compared with the data one at a time. The values of other
    sets have no intervals.
    """
    found: Fitted = tuple((part.effect, part.ci95) for part in report.found)
    alternatives = [
        together or _replaced(found, group.effects[0], effect)
        for group in report.indistinguishable
        for effect, together in zip(group.effects[1:], group.together[1:], strict=True)
    ]
    sets: list[Fitted] = [tuple((effect, {}) for effect in other.effects) for other in report.others]
    return [found, *alternatives, *sets]


def _replaced(found: Fitted, old: Effect, new: Effect) -> Fitted:
    """The explanation with another effect in an effect's place, and the values of the others unchanged."""
    return tuple((new, {}) if effect_name(effect) == effect_name(old) else (effect, ci95) for effect, ci95 in found)


def _drawn(effect: Effect, intervals: Intervals, rng: np.random.Generator) -> Effect:
    """The effect with a value drawn from each interval; parameters without a finite interval keep their values."""
    parameters = effect.parameters
    values: Mapping[str, float] = {
        name: _truncated_normal(parameters[name].value, (high - low) / 2.0 / HALF_WIDTH, parameters[name].bounds, rng)
        for name, (low, high) in intervals.items()
        if math.isfinite(low) and math.isfinite(high) and high > low
    }
    return effect.with_parameters(values) if values else effect


def _truncated_normal(mean: float, std: float, bounds: tuple[float, float], rng: np.random.Generator) -> float:
    low, high = bounds
    drawn = truncnorm.rvs((low - mean) / std, (high - mean) / std, loc=mean, scale=std, random_state=rng)
    return float(np.clip(drawn, low, high))  # rounding may cross a bound
