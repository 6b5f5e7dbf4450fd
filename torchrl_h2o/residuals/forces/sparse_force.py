"""Sparse regression of a force on a library of terms, selected by cross-validation over blocks of rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.residuals.forces.terms import NEGLIGIBLE, Factors, TermLibrary

DEPENDENT = 1e-12  # square of a unit column's part beside the chosen ones up to which it depends on them
MAX_TERMS = 3  # largest number of terms on one degree of freedom per round
BLOCKS = 10  # blocks of neighbouring rows that are held back together
FOLDS = 5  # folds of the cross-validation
TERM_LEVEL = 1e-4  # significance level of the F-test of a term, for a whole library
MIN_GAIN = 0.01  # share of the unexplained sum of squares that a term must explain


@dataclass(frozen=True)
class SparseForce:
    """A force on one degree of freedom as a sum of a few terms.

    Args:
        terms: the terms.
        gain: decrease of the weighted sum of squares on blocks held back.
    """

    terms: tuple[ForceTerm, ...] = ()
    gain: float = 0.0


def sparse_force(library: TermLibrary, force: np.ndarray, weight: np.ndarray) -> SparseForce:
    """Selects the terms of a library that explain a force.

    Terms are added by forward regression with orthogonal least squares (Billings, 2013, Nonlinear System
    Identification, chapter 3). A term is kept if it lowers the error
    on blocks of rows held back, by a minimum share and significantly: an F-test whose level is divided by the number of
    terms in the library.

    Args:
        library: terms on the degree of freedom.
        force: (W), in N or N·m.
        weight: (W), inverse variance of the force; rows of zero weight are left out.

    Returns:
        The terms; none if none passes.
    """
    known = weight > 0.0
    if known.sum() < 10 * BLOCKS or not force[known].any():
        return SparseForce()
    candidates = list(dict.fromkeys([*library.fixed(), *library.scanned(force, weight)]))
    columns = np.stack([library.column(factors) for factors in candidates], axis=1)
    root = np.sqrt(weight[known])
    design, target = root[:, None] * columns[known], root * force[known]
    size = np.linalg.norm(design, axis=0)
    moving = np.flatnonzero(size > NEGLIGIBLE * size.max())
    candidates, design = [candidates[i] for i in moving], design[:, moving] / size[moving]
    chosen, gain = _chosen(design, target)
    values = np.linalg.lstsq(design[:, chosen], target, rcond=None)[0] / size[moving][chosen]
    return SparseForce(
        tuple(_term(library, candidates[i], value) for i, value in zip(chosen, values, strict=True)), gain
    )


def _chosen(design: np.ndarray, target: np.ndarray) -> tuple[list[int], float]:
    """Indices of the selected columns, and the decrease of the sum of squares on blocks held back."""
    rows, choices = design.shape
    chance = f.isf(TERM_LEVEL / choices, 1, rows)
    before = left = float(target @ target)
    chosen = []
    for support in _growing_supports(design, target):
        loss = _held_back_loss(design[:, support], target)
        if left - loss < max(MIN_GAIN * before, chance * loss / rows):
            break
        chosen, left = support, loss
    return chosen, before - left


def _growing_supports(design: np.ndarray, target: np.ndarray) -> Iterator[list[int]]:
    """Sorted indices of one, two, ... ``MAX_TERMS`` columns; each new one explains most beside those before it."""
    left, support = design.copy(), []
    for _ in range(min(MAX_TERMS, design.shape[1])):
        square = (left**2).sum(0)
        possible = square > DEPENDENT
        possible[support] = False
        if not possible.any():
            return
        explained = np.where(possible, (left.T @ target) ** 2 / np.where(possible, square, 1.0), -1.0)
        support = sorted([*support, best := int(explained.argmax())])
        left = left - np.outer(left[:, best], left[:, best] @ left / square[best])
        yield support


def _held_back_loss(design: np.ndarray, target: np.ndarray) -> float:
    """Cross-validated sum of squares: each fold is predicted by a regression on the others."""
    fold = np.arange(len(target)) * BLOCKS // len(target) % FOLDS
    loss = 0.0
    for k in range(FOLDS):
        seen = fold != k
        solution = np.linalg.lstsq(design[seen], target[seen], rcond=None)[0]
        loss += float(((target[~seen] - design[~seen] @ solution) ** 2).sum())
    return loss


def _term(library: TermLibrary, factors: Factors, coefficient: float) -> ForceTerm:
    return ForceTerm(library.freedom.name, float(coefficient), factors, library.freedom.sliding)
