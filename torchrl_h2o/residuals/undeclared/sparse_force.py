"""Sparse regression of a force on a library of terms: as few terms as explain it, chosen on blocks held back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pysindy.optimizers import FROLS
from scipy.stats import f

from torchrl_h2o.effects.force.term import ForceTerm
from torchrl_h2o.residuals.undeclared.terms import Factors, TermLibrary

_MOST_TERMS = 3  # on one degree of freedom, in one go
_BLOCKS = 10  # neighbours in time are held back together
_FOLDS = 5
_LEVEL = 1e-4  # of the F-test of a term, for a whole library
_PAYS = 0.01  # share of what is unexplained that a term must explain
_STILL = 1e-9  # norm, relative, of a column that the others explain


@dataclass(frozen=True)
class SparseForce:
    """A force on one degree of freedom as a sum of few terms.

    Args:
        terms: the terms.
        gain: what they explain on blocks held back, as a reduction of the weighted sum of squares.
    """

    terms: tuple[ForceTerm, ...] = ()
    gain: float = 0.0


def sparse_force(library: TermLibrary, force: np.ndarray, weight: np.ndarray) -> SparseForce:
    """The few terms of a library that explain a force.

    Terms are added by forward regression with orthogonal least squares (FROLS). A term is kept if it lowers the error
    on blocks of neighbours that the regression has not seen, by a share worth a word, and by more than chance would:
    an F-test whose level is divided by the number of terms to choose from.

    Args:
        library: of the degree of freedom.
        force: (W), in N or N·m.
        weight: (W), one over its variance; rows without any weight are left out.

    Returns:
        The terms, none if none pays.
    """
    known = weight > 0.0
    if known.sum() < 10 * _BLOCKS or not force[known].any():
        return SparseForce()
    candidates = list(dict.fromkeys([*library.fixed(), *library.scanned(force, weight)]))
    columns = np.stack([library.column(factors) for factors in candidates], axis=1)
    root = np.sqrt(weight[known])
    design, target = root[:, None] * columns[known], root * force[known]
    size = np.linalg.norm(design, axis=0)
    moving = np.flatnonzero(size > _STILL * size.max())
    candidates, design = [candidates[i] for i in moving], design[:, moving] / size[moving]
    chosen, gain = _chosen(design, target)
    values = np.linalg.lstsq(design[:, chosen], target, rcond=None)[0] / size[moving][chosen]
    return SparseForce(
        tuple(_term(library, candidates[i], value) for i, value in zip(chosen, values, strict=True)), gain
    )


def _chosen(design: np.ndarray, target: np.ndarray) -> tuple[list[int], float]:
    """The columns that pay, and what they explain of blocks held back."""
    rows, choices = design.shape
    chance = f.isf(_LEVEL / choices, 1, rows)
    before = left = float(target @ target)
    chosen = []
    steps = FROLS(max_iter=_MOST_TERMS, alpha=1e-9, unbias=False).fit(design, target[:, None]).history_[1:]
    for coefficients in steps:
        support = np.flatnonzero(coefficients).tolist()
        loss = _held_back_loss(design[:, support], target)
        if left - loss < max(_PAYS * before, chance * loss / rows):
            break
        chosen, left = support, loss
    return chosen, before - left


def _held_back_loss(design: np.ndarray, target: np.ndarray) -> float:
    """The sum of squares of what regressions on all other blocks leave of each block."""
    fold = np.arange(len(target)) * _BLOCKS // len(target) % _FOLDS
    loss = 0.0
    for k in range(_FOLDS):
        seen = fold != k
        solution = np.linalg.lstsq(design[seen], target[seen], rcond=None)[0]
        loss += float(((target[~seen] - design[~seen] @ solution) ** 2).sum())
    return loss


def _term(library: TermLibrary, factors: Factors, coefficient: float) -> ForceTerm:
    return ForceTerm(library.freedom.name, float(coefficient), factors, library.freedom.sliding)
