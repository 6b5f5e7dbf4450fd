"""A robust, bounded regression of forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear


@dataclass(frozen=True, eq=False)
class ForceRegression:
    """A robust regression of forces.

    Args:
        shares: coefficients, (P).
        left: (W, nv), forces that are left.
        scale: (nv), usual size of what is left.
        least_needed: index of the coefficient without which the weighted square of what is left rises least; 0 if there
            is no coefficient.
    """

    shares: np.ndarray
    left: np.ndarray
    scale: np.ndarray
    least_needed: int

    @classmethod
    def fit(cls, missing: np.ndarray, changes: np.ndarray, bounds: np.ndarray, rounds: int = 6) -> ForceRegression:
        """Least squares with weights for the usual size of each force, and less weight for unusually large ones."""
        left, shares, cost = missing, np.zeros(0), np.zeros(1)
        for _ in range(rounds if changes.shape[-1] else 0):
            scale = usual_size(left)
            root = 1.0 / (scale * np.sqrt(np.maximum(1.0, np.abs(left / scale) / 2.0)))
            known = np.isfinite(missing)
            shares, cost = _least_squares((missing * root)[known], (changes * root[..., None])[known], bounds)
            left = missing + changes @ shares
        return cls(shares, left, usual_size(left), int(cost.argmin()))

    def losses(self, scale: np.ndarray) -> np.ndarray:
        """Mean robust loss of what is left of each force, (nv), in units of ``scale``."""
        return robust_losses(self.left, scale)


def robust_losses(force: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Mean robust loss of each force, (nv), in units of ``scale``."""
    return np.nanmean(np.log1p((force / scale) ** 2), axis=0)


def _least_squares(y: np.ndarray, changes: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounded shares, (P), that minimise the square of ``y``, (N), plus the changes, (N, P).

    Also returns the rise of the square without each of them, (P).
    """
    x = changes
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    inner = (x / size).T @ (x / size) + 1e-9 * np.eye(len(size))
    factor = np.linalg.cholesky(inner)
    towards = np.linalg.solve(factor, -(x / size).T @ y)
    scaled = lsq_linear(factor.T, towards, bounds * size, method="bvls").x
    return scaled / size, scaled**2 / np.diag(np.linalg.inv(inner))


def usual_size(force: np.ndarray) -> np.ndarray:
    """Usual size of each force, (nv), from (W, nv): the standard deviation of normal ones, from the median."""
    return 1.4826 * np.nanmedian(np.abs(force), axis=0) + 1e-12
