"""Thresholds and budgets of the search for a force outside the catalogue.

A share lies between 0 and 1; a spread is the standard deviation of an observed dimension over the data.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class UndeclaredSettings:
    """The search for a force outside the catalogue, and its comparison with the catalogue's effects."""

    min_gain: float = 0.01
    """Share of the held-out loss that all terms of the force must explain."""
    min_term_gain: float = 0.002
    """Share of the loss that a round must explain; removing a term may cost this share of the explained loss."""
    rounds: int = 6
    """Largest number of rounds of adding terms."""
    further_steps: int = 5
    """Control steps ahead at which the force must also lower the loss; a fit to sensor noise does not."""
    max_terms: int = 6
    """Largest number of terms of the whole force."""
    straight: float = 1.0
    """Largest phase, in rad, that a wave runs through over the measured positions for a line to be tried instead."""
    negligible: float = 1e-6
    """Residual, in spreads, that counts as rounding."""
    min_gain_over_catalogue: float = 0.05
    """Share of the held-out loss that a force must explain beside or instead of the catalogue's effects."""
    min_share: float = 0.01
    """Share of the whole reduction of the loss that the force must contribute."""
    beyond_noise: float = 2.0
    """Required multiple of the gain of a force found in synthetic data with sensor noise only."""


@dataclass(frozen=True)
class RegressionSettings:
    """The sparse regression of a force on a library of terms."""

    tails: float = 4.0
    """Degrees of freedom of the residuals' t-distribution; contacts and outliers make its tails heavy."""
    scatter_iterations: int = 15
    """Iterations of the scatter estimate."""
    shrinkage: float = 0.01
    """Shrinkage of the scatter towards its diagonal, so that it can be inverted without noise."""
    force_nudge: float = 0.1
    """Step of the finite differences by the force, as a share of the typical force."""
    max_terms: int = 3
    """Largest number of terms on one degree of freedom per round."""
    blocks: int = 10
    """Blocks of neighbouring rows that are held back together."""
    folds: int = 5
    """Folds of the cross-validation."""
    level: float = 1e-4
    """Significance level of the F-test of a term, for a whole library."""
    min_gain: float = 0.01
    """Share of the unexplained sum of squares that a term must explain."""
    negligible: float = 1e-9
    """Relative spread or norm at which a coordinate or column counts as constant."""
    max_waves: float = 15.0
    """Largest number of periods over the range of a position; faster waves cannot be distinguished from noise."""
    max_harmonic: float = 30.0
    """Largest number of periods per turn of a hinge, such as the torque ripple of a motor with many poles."""
    scan_spacing: float = 0.8
    """Spacing of scanned frequencies, in rad over the range."""
    max_scanned: int = 1500
    """Largest number of scanned frequencies."""
    scanned_values: int = 5000
    """Number of positions on which frequencies are scanned; the best one is then refined on all positions."""
    min_periods: float = 1.5
    """Smallest number of periods of a wave in time; fewer cannot be distinguished from a trend."""
    min_step_share: float = 0.03
    """Smallest share of the rows on either side of a step in time."""
