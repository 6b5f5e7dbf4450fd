"""Variances of action and sensor noise, fitted to the covariance of one-step residuals by Fisher scoring."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.stats import chi2

from torchrl_h2o.residuals.noise.scatter import Scatter
from torchrl_h2o.residuals.settings import DEFAULTS, NoiseSettings


def fitted_variances(
    scatter: Scatter, sensor_std: np.ndarray, settings: NoiseSettings = DEFAULTS.noise
) -> tuple[np.ndarray, np.ndarray]:
    """Fits the variances of action and sensor noise to squared residuals, by Fisher scoring.

    The covariance of a residual is linear in the variances; squared residuals are weighted by its inverse.

    Args:
        scatter: the residuals and their derivatives.
        sensor_std: (n), lower bounds of the sensors' standard deviations, in their units.
        settings: blocks, iterations and robustness.

    Returns:
        Variances (1 + n): first of the action, in squared units of the action (one for all actuators; 0 without
        derivatives by it), then of each sensor, in squared scales. And the action's variance with each block of the
        data left out in turn, (blocks).
    """
    found, least = np.zeros((2, 1 + scatter.residual.shape[1]))
    least[1:] = (sensor_std / scatter.scale) ** 2
    for _ in range(settings.iterations):
        inner, towards = _normal_equations(scatter, found, settings)
        found = _at_least(least, inner.sum(0), towards.sum(0))
    left_out = [
        _at_least(least, inner.sum(0) - one, towards.sum(0) - other)[0]
        for one, other in zip(inner, towards, strict=True)
    ]
    return found, np.array(left_out)


def _normal_equations(
    scatter: Scatter, variances: np.ndarray, settings: NoiseSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of one scoring step per block of the data: (blocks, 1 + n, 1 + n) and (blocks, 1 + n)."""
    n = scatter.residual.shape[1]
    covariance = (
        _covariance(variances, scatter, settings)
        if variances.any()
        else np.tile(np.eye(n), (len(scatter.residual), 1, 1))
    )
    inverse = np.linalg.inv(covariance)
    whitened = (inverse @ scatter.residual[..., None])[..., 0]
    distance = (whitened * scatter.residual).sum(-1)
    # effective number of directions in which noise exceeds the floor
    rank = np.maximum(1.0, n - settings.variance_floor * inverse.trace(axis1=1, axis2=2)) if variances.any() else n
    most = chi2.ppf(settings.usual, rank)
    trust = np.minimum(1.0, most / np.maximum(distance, 1e-12))
    trust /= (
        chi2.cdf(most, rank + 2.0) + (1.0 - settings.usual) * most / rank
    )  # keeps the estimate unbiased for normal noise
    by_action = scatter.clamped(float(np.sqrt(variances[0])))
    parts = np.empty((1 + n, len(inverse), n, n))
    parts[0] = by_action @ by_action.swapaxes(1, 2)
    by_sensor = scatter.by_sensor.transpose(2, 0, 1)
    parts[1:] = by_sensor[..., None] * by_sensor[..., None, :]
    parts[range(1, 1 + n), :, range(n), range(n)] += 1.0
    weighed = inverse @ parts
    inner = np.einsum("kwij,lwji->wkl", weighed, weighed, optimize=True)
    towards = trust[:, None] * np.einsum("wi,kwij,wj->wk", whitened, parts, whitened, optimize=True)
    blocks = np.array_split(np.arange(len(inverse)), settings.blocks)
    return np.array([inner[rows].sum(0) for rows in blocks]), np.array([towards[rows].sum(0) for rows in blocks])


def _covariance(variances: np.ndarray, scatter: Scatter, settings: NoiseSettings) -> np.ndarray:
    """Covariance of each residual, (W, n, n)."""
    by_action, by_sensor = scatter.clamped(float(np.sqrt(variances[0]))), scatter.by_sensor
    return (
        variances[0] * by_action @ by_action.swapaxes(1, 2)
        + (by_sensor * variances[1:]) @ by_sensor.swapaxes(1, 2)
        + np.diag(variances[1:] + settings.variance_floor)
    )


def _at_least(least: np.ndarray, inner: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Least-squares solution of normal equations under lower bounds."""
    diagonal = np.diag(inner)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    root = np.linalg.cholesky(inner / np.outer(size, size) + 1e-12 * np.eye(len(inner)))
    return least + nnls(root.T, np.linalg.solve(root, (towards - inner @ least) / size))[0] / size


def log_likelihood(variances: np.ndarray, scatter: Scatter, settings: NoiseSettings = DEFAULTS.noise) -> np.ndarray:
    """Log-likelihood of each residual, (W), up to a constant, under a t-distribution."""
    covariance = _covariance(variances, scatter, settings)
    distance = (scatter.residual * np.linalg.solve(covariance, scatter.residual[..., None])[..., 0]).sum(-1)
    _, volume = np.linalg.slogdet(covariance)
    tails = settings.tails
    return -0.5 * volume - 0.5 * (tails + scatter.residual.shape[1]) * np.log1p(distance / tails)
