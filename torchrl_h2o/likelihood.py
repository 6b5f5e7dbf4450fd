"""Log densities of errors, and by how much one explanation predicts better than another."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

ENOUGH = math.log(100.0)  # evidence from which an explanation is better than another: a likelihood ratio of 100
TAIL = 4.0  # degrees of freedom of Student's t, by which errors are distributed
ACTS = 0.02  # difference of a block, in nats, below which two explanations predict it alike
MOST_NATS = 20.0  # difference of a block beyond which it says no more
FEWEST = 4  # blocks that must differ
LOG_ODDS = np.logspace(-2.0, 0.0, 21)  # tried log odds that a difference is positive, per nat; a likelihood ratio has 1
BLOCKS = 30  # blocks of neighbouring windows, which count as independent


def log_density(z: np.ndarray) -> np.ndarray:
    """Log density of Student's t with ``TAIL`` degrees of freedom and variance 1."""
    constant = math.lgamma((TAIL + 1.0) / 2.0) - math.lgamma(TAIL / 2.0) - 0.5 * math.log((TAIL - 2.0) * math.pi)
    return constant - (TAIL + 1.0) / 2.0 * np.log1p(z**2 / (TAIL - 2.0))


@dataclass(frozen=True, eq=False)
class Difference:
    """By how much one explanation predicts better than another, paired over blocks.

    Args:
        by_block: (B), in nats.
    """

    by_block: np.ndarray

    @classmethod
    def of_losses(cls, worse: np.ndarray, better: np.ndarray) -> Difference:
        """By how much losses of neighbouring windows, (W) in order of time, are lower than others.

        The losses of a block are taken as those of exponential distributions, whose likeliest scales are their means.
        What acts in fewer than ``FEWEST`` blocks shows no evidence.
        """
        parts = np.array_split(np.arange(len(worse)), min(BLOCKS, len(worse)))
        least = 1e-6 * worse.mean() + 1e-300
        ratios = [len(part) * np.log((worse[part].mean() + least) / (better[part].mean() + least)) for part in parts]
        return cls(np.array(ratios))

    @property
    def mean(self) -> float:
        """Mean over the blocks, in nats a block."""
        return float(self.by_block.mean())

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return float(self.by_block.std(ddof=1) / np.sqrt(max(1, len(self.by_block))))

    @property
    def acting(self) -> int:
        """Number of blocks that differ."""
        return int((np.abs(self.by_block) > ACTS).sum())

    @property
    def evidence(self) -> float:
        """Logarithm of the likelihood ratio of a positive mean and none, in nats; negative for a negative mean.

        It is the larger one of two: that of the differences as normal values with the scatter that they have, and that
        of their signs, whose log odds are in proportion to the size. What acts in bursts, such as play in a gear, makes
        a few blocks much better; their scatter hides the mean from the first, but not from the second. What acts
        rarely, such as the end of a joint's range, leaves most blocks as they are, so only those count that differ.
        """
        alike = np.abs(self.by_block) <= ACTS  # False for NaN, which must not pass for no evidence
        acting = np.clip(self.by_block[~alike], -MOST_NATS, MOST_NATS)
        if len(acting) < FEWEST:
            return 0.0
        n, mean = len(acting), acting.mean()
        normal = 0.5 * n * np.log1p(mean**2 / max(acting.var(ddof=1) / n, 1e-24) / (n - 1))
        signs = n * math.log(2.0) - np.logaddexp(0.0, -LOG_ODDS[:, None] * np.sign(mean) * acting).sum(1).min()
        return float(np.sign(mean) * np.maximum(normal, signs))
