"""Paired one-sided tests of whether one explanation has a lower held-out loss than another."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy.stats import t as student
from scipy.stats import wilcoxon

from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings

MAX_RATIO = 100.0  # largest factor that a single block may contribute to the third test's likelihood ratio
LOSS_FLOOR = 1e-6  # smallest typical loss of a block, as a share of the mean loss
WORST = 1e3  # bound on a scaled residual, also used where the simulation diverges


def p_value(gain: np.ndarray, settings: LoopSettings = DEFAULTS) -> float:
    """Tests whether the mean gain exceeds zero.

    Args:
        gain: (W), decrease of each held-out window's loss, in order of time.
        settings: number of blocks.

    Returns:
        The smaller p-value of two one-sided tests on block means, doubled: Student's t test, which detects large and
        rare gains, and Wilcoxon's signed-rank test, which detects small and widespread ones.
    """
    blocks = np.array([part.mean() for part in np.array_split(gain, min(settings.blocks, len(gain))) if len(part)])
    spread = blocks.std(ddof=1) / np.sqrt(len(blocks))
    if spread == 0.0:
        return 0.0 if blocks.mean() > 0.0 else 1.0
    by_size = student.sf(blocks.mean() / spread, len(blocks) - 1)
    by_rank = cast("Any", wilcoxon(blocks, alternative="greater")).pvalue
    return float(min(1.0, 2.0 * min(by_size, by_rank)))


def p_value_of_losses(before: np.ndarray, after: np.ndarray, settings: LoopSettings = DEFAULTS) -> float:
    """Tests whether losses decrease from one explanation to another.

    An effect that acts rarely, such as a joint limit, may change three blocks of thirty, too few for a test on means.
    A third test therefore detects residuals that nearly vanish in a few blocks. Its statistic is the product, over the
    blocks, of sqrt((m + before) / (m + after)) with the block's losses and the median m of the losses ``after``. For
    squared residuals, this is the square root of a likelihood ratio of Cauchy distributions with median squared
    residual m. If the residuals of the first explanation have this distribution, its mean is at most one (it is a
    Hellinger affinity), so Markov's inequality makes its inverse a p-value. For block means of a robust loss this holds
    only approximately. In simulations with residuals of very different sizes, also concentrated in a few blocks, and
    changes that are independent of them, at most 0.4 % of the values were below 0.01. It does not hold if the two
    losses are independent of each other.

    Args:
        before: (W), loss of each held-out window with the first explanation, in order of time.
        after: (W), the same with the second explanation.
        settings: blocks, and bounds of the ratio of the losses.

    Returns:
        The smallest of three p-values, tripled: those of the two tests of :func:`p_value`, and the inverse of the third
        test's statistic.
    """
    blocks = [part for part in np.array_split(np.arange(len(before)), min(settings.blocks, len(before))) if len(part)]
    b, a = (np.array([loss[part].mean() for part in blocks]) for loss in (before, after))
    usual = max(np.median(a), LOSS_FLOOR * b.mean())
    if usual == 0.0:
        return 1.0
    log_ratio = np.minimum(0.5 * np.log((usual + b) / (usual + a)), np.log(MAX_RATIO)).sum()
    return float(min(1.0, 1.5 * p_value(before - after, settings), 3.0 * np.exp(-max(log_ratio, 0.0))))
