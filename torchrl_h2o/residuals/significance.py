"""Whether one explanation beats another by more than chance would: a paired test on held-out data."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student
from scipy.stats import wilcoxon

BLOCKS = 30  # of neighbouring windows, whose residuals depend on each other
IN_WORDS = (
    f"one-sided tests (Student's t and Wilcoxon's) on the held-out loss, paired over {BLOCKS} blocks of neighbouring "
    "windows, at 1 % divided by the number of effects tried; where sensors are noisy, also four times the share of the "
    "loss that the same effect would explain if nothing but noise were there"
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
