"""Errors of predictions in units of their scale, with the weights of the robust score."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_h2o.likelihood import TAIL
from torchrl_h2o.residuals.score import Predictions

LEAST_CURVATURE = 0.1  # of the log density over the weights, where most errors are outliers

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


def excess_of_weights(white: np.ndarray, share: np.ndarray) -> float:
    """Factor by which the weights exceed minus the second derivative of the log density, for errors with shares, (N,).

    The weights make each step of a fit safe. How far the maximum is, and how uncertain, follows from the second
    derivative (P. J. Huber, *Robust Statistics*, 1981, section 7.6).

    Examples:
        >>> import numpy as np
        >>> normal = np.random.default_rng(0).standard_normal(100_000)
        >>> round(excess_of_weights(normal, np.ones(100_000)), 2)
        1.57
    """
    second = (TAIL + 1.0) * (TAIL - 2.0 - white**2) / (TAIL - 2.0 + white**2) ** 2
    weight = float(share @ weights(white))
    return weight / max(float(share @ second), LEAST_CURVATURE * weight)


def block_of(part: Predictions) -> np.ndarray:
    """Index of the block of each error of :func:`flat`, (N)."""
    n = part.record.num_readings
    return np.concatenate([np.repeat(w.block, len(w.horizons) * n) for w in part.blocks.windows])
