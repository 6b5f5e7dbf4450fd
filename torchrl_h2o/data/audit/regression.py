"""Robust linear fits of the changes of the velocities to responses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted linear combination of responses.

    Args:
        values: coefficients, (P,).
        errors: their standard errors, (P,).
        unexplained: weighted share of the target's square that is left.
    """

    values: np.ndarray
    errors: np.ndarray
    unexplained: float


def fit(target: np.ndarray, responses: np.ndarray, scale: np.ndarray, weights: np.ndarray) -> Fit:
    """Least squares of ``target`` (W, m) on ``responses`` (W, m, P), in units of ``scale`` (m,), weighted (W, m)."""
    root = np.sqrt(weights) / scale
    y, x = (target * root).ravel(), (responses * root[..., None]).reshape(-1, responses.shape[-1])
    size = np.sqrt((x**2).sum(0))
    size = np.where(size > 0.0, size, 1.0)
    gram = (x / size).T @ (x / size) + 1e-9 * np.eye(len(size))
    values = np.linalg.solve(gram, (x / size).T @ y)
    left = float(((y - x / size @ values) ** 2).sum())
    free = max(1, int((root > 0.0).sum()) - len(size))
    # windows follow each other closely, so their errors are correlated: two velocities count as one
    errors = np.sqrt(2.0 * left / free * np.diag(np.linalg.inv(gram)))
    return Fit(values / size, errors / size, left / max(float((y**2).sum()), 1e-300))


def robust_weights(error: np.ndarray, bound: float) -> np.ndarray:
    """Weights (W, m) of Huber's loss for errors (W, m); zero where an error is not finite."""
    finite = np.isfinite(error)
    usual = np.nanmedian(np.where(finite, np.abs(error), np.nan), axis=0)
    limit = bound * np.maximum(1.4826 * usual, 1e-12)
    return np.where(finite, np.minimum(1.0, limit / np.maximum(np.abs(error), 1e-12)), 0.0)


def robust_fit(target: np.ndarray, responses: np.ndarray, scale: np.ndarray, bound: float, rounds: int = 3) -> Fit:
    """Fits with Huber's weights, reweighted a few times; rows that are not finite are left out."""
    finite = np.isfinite(target) & np.isfinite(responses).all(-1)
    target, responses = np.where(finite, target, 0.0), np.where(finite[..., None], responses, 0.0)
    weights = finite * robust_weights(target / scale, bound)
    found = fit(target, responses, scale, weights)
    for _ in range(rounds):
        weights = finite * robust_weights((target - responses @ found.values) / scale, bound)
        found = fit(target, responses, scale, weights)
    return found
