"""Compares explanations by their typical residuals, which a few large ones do not hide.

Coordinates that are not observed are estimated by simulation. At contacts an estimate is sometimes wrong, as of a wheel
that leaves the ground a step too late. The robust loss of a fit follows the large residuals that this causes.
"""

from __future__ import annotations

import numpy as np

from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState


def log_losses(problem: Problem, fitted: Fit) -> np.ndarray:
    """Cauchy loss of each window by which effects are chosen, (W), with the residuals' scales of a problem."""
    return np.log1p(problem.selection_residuals(fitted.effects) ** 2).mean((1, 2))


def is_finer(problem: Problem, before: Problem, ratio: float) -> bool:
    """Whether the residuals' scale in the median dimension is below this ratio of the scale in another problem."""
    new, old = (np.median(one.scale, axis=(0, 1)) for one in (problem, before))
    return bool(np.median(new / old) < ratio)


def leaves_much_finer(state: SearchState, fitted: Fit, than: Fit, level: float) -> bool:
    """Whether an explanation leaves a much smaller typical residual than another one, by windows that no fit has used.

    The residuals are scaled by what the explanation leaves. With the scales of the other one, a residual of a tenth and
    one of a hundredth have nearly the same loss.

    Args:
        state: the state of the search.
        fitted: the explanation.
        than: the other one.
        level: significance level of the paired test on the windows by which effects are chosen.

    Returns:
        The result; False if all coordinates are observed, because the robust loss then decides alone.
    """
    if not state.problem.simulation.state_map.hidden or not _is_lower(state, state.problem, fitted, than, 1.0):
        return False
    left, other = (state.posed_at(one.effects) for one in (fitted, than))
    return is_finer(left, other, state.settings.trace.much_finer) and _is_lower(state, left, fitted, than, level)


def _is_lower(state: SearchState, scaled_by: Problem, fitted: Fit, than: Fit, level: float) -> bool:
    """Whether the Cauchy loss of an explanation is lower than that of another one, significantly at a level."""
    problem = state.rescaled(scaled_by).problem
    before, after = (log_losses(problem, which) for which in (than, fitted))
    return bool(after.mean() < before.mean() and state.p_value(before, after) <= level)
