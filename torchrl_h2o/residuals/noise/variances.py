"""Variances of action and sensor noise, fitted to the covariance of one-step residuals by Fisher scoring."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.stats import chi2

from torchrl_h2o.residuals.noise.scatter import Scatter

BLOCKS = 10  # blocks of the data that are left out in turn for the interval
ITERATIONS = 8  # iterations of the Fisher scoring
# variance added to every dimension, as a share of the squared mean residual; allows for inexact derivatives
VARIANCE_FLOOR = 1e-3
USUAL = 0.995  # quantile of normal residuals beyond which a residual is clipped; contacts cause outliers
TAILS = 4.0  # degrees of freedom of the t-distribution in the held-out likelihood; contacts cause outliers


def fitted_variances(scatter: Scatter, sensor_std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fits the variances of action and sensor noise to squared residuals, by Fisher scoring.

    The covariance of a residual is linear in the variances; squared residuals are weighted by its inverse.

    Args:
        scatter: the residuals and their derivatives.
        sensor_std: (n), lower bounds of the sensors' standard deviations, in their units.

    Returns:
        Variances (1 + n): first of the action, in squared units of the action (one for all actuators; 0 without
        derivatives by it), then of each sensor, in squared scales. And the action's variance with each block of the
        data left out in turn, (blocks).
    """
    found, least = np.zeros((2, 1 + scatter.residual.shape[1]))
    least[1:] = (sensor_std / scatter.scale) ** 2
    for _ in range(ITERATIONS):
        inner, towards = _normal_equations(scatter, found)
        found = _at_least(least, inner.sum(0), towards.sum(0))
    left_out = [
        _at_least(least, inner.sum(0) - one, towards.sum(0) - other)[0]
        for one, other in zip(inner, towards, strict=True)
    ]
    return found, np.array(left_out)


def _normal_equations(scatter: Scatter, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of one scoring step per block of the data: (blocks, 1 + n, 1 + n) and (blocks, 1 + n)."""
    n = scatter.residual.shape[1]
    covariance = (
        _covariance(variances, scatter) if variances.any() else np.tile(np.eye(n), (len(scatter.residual), 1, 1))
    )
    inverse = np.linalg.inv(covariance)
    whitened = (inverse @ scatter.residual[..., None])[..., 0]
    distance = (whitened * scatter.residual).sum(-1)
    # effective number of directions in which noise exceeds the floor
    rank = np.maximum(1.0, n - VARIANCE_FLOOR * inverse.trace(axis1=1, axis2=2)) if variances.any() else n
    most = chi2.ppf(USUAL, rank)
    trust = np.minimum(1.0, most / np.maximum(distance, 1e-12))
    trust /= chi2.cdf(most, rank + 2.0) + (1.0 - USUAL) * most / rank  # keeps the estimate unbiased for normal noise
    by_action = scatter.clamped(float(np.sqrt(variances[0])))
    parts = np.empty((1 + n, len(inverse), n, n))
    parts[0] = by_action @ by_action.swapaxes(1, 2)
    by_sensor = scatter.by_sensor.transpose(2, 0, 1)
    parts[1:] = by_sensor[..., None] * by_sensor[..., None, :]
    parts[range(1, 1 + n), :, range(n), range(n)] += 1.0
    weighed = inverse @ parts
    inner = np.einsum("kwij,lwji->wkl", weighed, weighed, optimize=True)
    towards = trust[:, None] * np.einsum("wi,kwij,wj->wk", whitened, parts, whitened, optimize=True)
    blocks = np.array_split(np.arange(len(inverse)), BLOCKS)
    return np.array([inner[rows].sum(0) for rows in blocks]), np.array([towards[rows].sum(0) for rows in blocks])


def _covariance(variances: np.ndarray, scatter: Scatter) -> np.ndarray:
    """Covariance of each residual, (W, n, n)."""
    by_action, by_sensor = scatter.clamped(float(np.sqrt(variances[0]))), scatter.by_sensor
    return (
        variances[0] * by_action @ by_action.swapaxes(1, 2)
        + (by_sensor * variances[1:]) @ by_sensor.swapaxes(1, 2)
        + np.diag(variances[1:] + VARIANCE_FLOOR)
    )


def _at_least(least: np.ndarray, inner: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Least-squares solution of normal equations under lower bounds."""
    diagonal = np.diag(inner)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    root = np.linalg.cholesky(inner / np.outer(size, size) + 1e-12 * np.eye(len(inner)))
    return least + nnls(root.T, np.linalg.solve(root, (towards - inner @ least) / size))[0] / size


def log_likelihood(variances: np.ndarray, scatter: Scatter) -> np.ndarray:
    """Log-likelihood of each residual, (W), up to a constant, under a t-distribution."""
    covariance = _covariance(variances, scatter)
    distance = (scatter.residual * np.linalg.solve(covariance, scatter.residual[..., None])[..., 0]).sum(-1)
    _, volume = np.linalg.slogdet(covariance)
    tails = TAILS
    return -0.5 * volume - 0.5 * (tails + scatter.residual.shape[1]) * np.log1p(distance / tails)
