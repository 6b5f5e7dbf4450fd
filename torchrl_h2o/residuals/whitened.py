"""Errors of predictions in units of their scale, with the weights of the robust score."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.likelihood import TAIL
from torchrl_h2o.residuals.score import Predictions

Whitened = tuple[np.ndarray, np.ndarray, np.ndarray]


def flat(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Errors of all windows in one vector."""
    return np.concatenate([one.ravel() for one in arrays])


def whitened(part: Predictions, errors: Sequence[np.ndarray], scales: Sequence[np.ndarray]) -> Whitened:
    """Whitened errors, the inverse of their scale, and their shares in the score, each (N)."""
    roots = [1.0 / np.sqrt(variance + scale) for variance, scale in zip(part.variances, scales, strict=True)]
    shares = [np.broadcast_to(share[:, None], one.shape) for share, one in zip(part.shares, errors, strict=True)]
    inverse = flat(roots)
    return flat(errors) * inverse, inverse, flat(shares)


def weights(white: np.ndarray) -> np.ndarray:
    """Weights with which half the sum of squares of whitened errors has the gradient of the log density."""
    return (TAIL + 1.0) / (TAIL - 2.0 + white**2)


def block_of(part: Predictions) -> np.ndarray:
    """Index of the block of each error of :func:`flat`, (N)."""
    n = part.record.num_readings
    return np.concatenate([np.repeat(w.block, len(w.horizons) * n) for w in part.blocks.windows])
