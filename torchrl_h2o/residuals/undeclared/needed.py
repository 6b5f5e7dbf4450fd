"""Removes effects of the catalogue that a force outside the catalogue makes redundant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.trace.fit import fit
from torchrl_h2o.residuals.trace.outcome import Trace
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import free_parameters
from torchrl_h2o.residuals.trace.significance import p_value_of_losses

# share of the held-out loss that a force must explain beside or instead of the catalogue's effects
MIN_GAIN_OVER_CATALOGUE = 0.05


def needed_parts(
    problem: Problem, trace: Trace, parts: Sequence[Part], settings: LoopSettings = DEFAULTS
) -> tuple[Part, ...]:
    """Removes each effect without which the other parts, fitted again, explain the held-out data equally well.

    Args:
        problem: simulation without the parts, data and scales of the residuals.
        trace: search that found the catalogue's effects.
        parts: the catalogue's effects, then the force, which is always kept.
        settings: thresholds and budgets.

    Returns:
        The remaining parts, fitted together.
    """
    chosen = list(range(len(parts)))
    best, lowest = _refitted(problem, trace, parts, chosen, settings)
    for index in range(len(parts) - 1):
        rest = [i for i in chosen if i != index]
        candidate, after = _refitted(problem, trace, parts, rest, settings)
        close = after.mean() < lowest.mean() / (1.0 - MIN_GAIN_OVER_CATALOGUE)
        if close or p_value_of_losses(after, lowest, settings) > settings.level:
            chosen, best, lowest = rest, candidate, after
    return best


def _refitted(
    problem: Problem, trace: Trace, parts: Sequence[Part], chosen: Sequence[int], settings: LoopSettings
) -> tuple[tuple[Part, ...], np.ndarray]:
    """Some of the parts, fitted together, and their held-out losses, (W)."""
    free = [free_parameters(trace.entries[i]) if parts[i].declared else tuple(parts[i].ci95) for i in range(len(parts))]
    effects = [parts[i].effect for i in chosen]
    free, starts = [free[i] for i in chosen], problem.measured.fitted(problem.horizon)
    result = fit(problem, effects, free, starts, max_evaluations=settings.max_evaluations)
    refitted = tuple(
        Part(effect, parts[i].declared, result.ci95(position), parts[i].alike)
        for position, (i, effect) in enumerate(zip(chosen, result.effects, strict=True))
    )
    return refitted, problem.selection_losses(result.effects)
