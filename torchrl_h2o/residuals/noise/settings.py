"""Thresholds and budgets of the estimate of action noise.

A share lies between 0 and 1; a spread is the standard deviation of an observed dimension over the data.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class NoiseSettings:
    """The estimate of action noise from the scatter of the residuals."""

    blocks: int = 10
    """Blocks of the data that are left out in turn for the interval."""
    iterations: int = 8
    """Iterations of the Fisher scoring."""
    nudge: float = 1e-4
    """Step of the finite differences, in spreads or in shares of the largest action."""
    variance_floor: float = 1e-3
    """Variance added to every dimension, as a share of the squared mean residual; allows for inexact derivatives."""
    usual: float = 0.995
    """Quantile of normal residuals beyond which a residual is clipped; contacts cause outliers."""
    tails: float = 4.0
    """Degrees of freedom of the t-distribution in the held-out likelihood; contacts cause outliers."""
    min_share: float = 1e-3
    """Smallest reported standard deviation, as a share of the control range."""
    max_share: float = 2.0
    """Largest plausible standard deviation, in RMS of the actions; larger estimates come from filtered sensors."""
    min_half_widths: float = 3.0
    """Number of half-widths that the estimate must exceed, because the interval omits errors that blocks share."""
    beyond_sensors: float = 3.0
    """Required multiple of the estimate from synthetic data with sensor noise only."""
    min_change: float = 0.1
    """Smallest reported change, as a share of the variance of the simulator's own action noise."""
