"""Compares two explanations of the data closely: with residuals scaled by what each of them leaves.

Residuals that are scaled by their size without an effect hide small differences between two candidates for its place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.effects import CatalogueEntry
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState

SAME_LOSS = 1e-6  # loss difference between alternatives, as a share of the effect's gain, that counts as rounding
ALIKE_LOSS = 0.1  # loss difference, as a share of the effect's gain, beyond which an alternative is ruled out


def refined(state: SearchState, entries: Sequence[CatalogueEntry], fitted: Fit) -> Fit:
    """The fit of an explanation, continued with residuals scaled by what it leaves."""
    return state.rescaled(state.posed_instead(fitted.effects)).refitted(entries, fitted.effects)


def worse_of(state: SearchState, one: Fit, other: Fit) -> Fit | None:
    """The explanation that is clearly and significantly worse under both scalings of the residuals; None if none is."""
    scaled = [state.rescaled(state.posed_instead(scaling.effects)) for scaling in (one, other)]
    for worse, better in ((one, other), (other, one)):
        if all(_is_worse(at, worse, better) for at in scaled):
            return worse
    return None


def _is_worse(state: SearchState, one: Fit, by: Fit) -> bool:
    """Whether the loss of an explanation is significantly, and by more than a small share, higher than another's."""
    own, other = (_log_losses(state.problem, which) for which in (one, by))
    far = own.mean() > (1.0 + ALIKE_LOSS) * other.mean()
    return bool(far and state.p_value(own, other) < state.settings.level)


def _log_losses(problem: Problem, fitted: Fit) -> np.ndarray:
    """Cauchy loss of each window by which effects are chosen, (W), which single large residuals hardly change."""
    return np.log1p(problem.selection_residuals(fitted.effects) ** 2).mean((1, 2))
