"""Whether one explanation beats another by more than chance would: a paired test on held-out data."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student
from scipy.stats import wilcoxon

BLOCKS = 30  # of neighbouring windows, whose residuals depend on each other
_MOST_ODDS = 100.0  # to one, that one block may give
_NOTHING = 1e-6  # of the mean loss
IN_WORDS = (
    f"one-sided tests (Student's t, Wilcoxon's, and the odds of the losses) on the held-out loss, paired over {BLOCKS} "
    "blocks of neighbouring windows, at 1 % divided by the number of effects tried; where sensors are noisy, also four "
    "times the share of the loss that the same effect would explain if nothing but noise were there"
)


def p_value(gain: np.ndarray) -> float:
    """The chance to see such a gain where there is none.

    Args:
        gain: (W), how much lower the loss of each held-out window is, in their order in time.

    Returns:
        The p-value of two one-sided tests on the means of blocks, the better of them counted twice: Student's t, which
        sees what is rare and large, and Wilcoxon's signed ranks, which see what is small and everywhere.
    """
    blocks = np.array([part.mean() for part in np.array_split(gain, min(BLOCKS, len(gain))) if len(part)])
    spread = blocks.std(ddof=1) / np.sqrt(len(blocks))
    if spread == 0.0:
        return 0.0 if blocks.mean() > 0.0 else 1.0
    by_size = student.sf(blocks.mean() / spread, len(blocks) - 1)
    by_rank = wilcoxon(blocks, alternative="greater").pvalue
    return float(min(1.0, 2.0 * min(by_size, by_rank)))


def p_value_of_losses(before: np.ndarray, after: np.ndarray) -> float:
    """The chance to see losses fall so where there is nothing that makes them fall.

    What acts now and then, such as the end of a joint's range, may show in three blocks of thirty, too few for tests on
    means however large it is. But what changes residuals by chance hardly ever makes them vanish: that one shrinks to a
    part of 1/c has a chance of about 1/c. So who bets on it is paid, in each block, the square root of the ratio of the
    losses, and breaks even at best; such a stake grows a hundredfold once in a hundred times (Ville's inequality).

    Args:
        before: (W), the loss of each held-out window without an effect, in their order in time.
        after: (W), the same with it.

    Returns:
        The p-value of three tests, those of :func:`p_value` and this bet, the best of them counted three times.
    """
    blocks = [part for part in np.array_split(np.arange(len(before)), min(BLOCKS, len(before))) if len(part)]
    b, a = (np.array([loss[part].mean() for part in blocks]) for loss in (before, after))
    usual = max(np.median(a), _NOTHING * b.mean())
    if usual == 0.0:
        return 1.0
    odds = np.minimum(0.5 * np.log((usual + b) / (usual + a)), np.log(_MOST_ODDS)).sum()
    return float(min(1.0, 1.5 * p_value(before - after), 3.0 * np.exp(-max(odds, 0.0))))
