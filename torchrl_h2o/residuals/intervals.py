"""How uncertain fitted values are: their intervals, their values in each log, and the scatter of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.effects import Parameter
from torchrl_h2o.likelihood import log_density
from torchrl_h2o.residuals.between_logs import LEVEL, half_widths_between, p_values
from torchrl_h2o.residuals.score import Predictions
from torchrl_h2o.residuals.whitened import Whitened, block_of, excess_of_weights, weights

CONFIDENCE = 1.96  # standard errors from a value to the end of its 95 % interval
REWEIGHTED = 8  # steps to the best values of a log, if the errors are linear
SINGULAR = 1e-10  # share of the largest curvature below which the data do not show a combination of values
KNOWN = 0.99  # share of a value that lies outside such combinations, from which on the data show it


@dataclass(frozen=True, eq=False)
class Spreads:
    """How uncertain the variables of a fit are.

    Args:
        half_widths: half-widths of the 95 % intervals, (p,).
        scatter: in quadrature, what the scatter between logs adds for the value in another log, (p,); 0 for one log.
        logs: indices of the logs.
        moves: the moves to the best values of each log alone, (logs, p).
        errors: standard errors of these, (logs, p); infinite where a log does not contain the value.
    """

    half_widths: np.ndarray
    scatter: np.ndarray
    logs: tuple[int, ...]
    moves: np.ndarray
    errors: np.ndarray


def spreads_of(
    parts: Sequence[Predictions],
    found: Sequence[Whitened],
    slopes: Sequence[np.ndarray],
    white_at: Callable[[np.ndarray], np.ndarray],
) -> Spreads:
    """Sandwich estimates with each block as one observation, of all logs and of each log alone.

    Args:
        parts: predictions of the rows of the fit.
        found: errors of each part, see :func:`~torchrl_h2o.residuals.whitened.whitened`.
        slopes: derivatives of the errors by the variables, (N, p) for each part.
        white_at: simulates the whitened errors of all parts, (N,), at other values of the variables, (p,). It is called
            once for each log if the logs differ: far from the common values, the errors are not linear in the values.
    """
    count, logs, blocks, rows = 0, [], [], []
    for part, (white, inverse, share), slope in zip(parts, found, slopes, strict=True):
        block, log = block_of(part), part.record.measured.log
        logs.append(np.zeros(len(part.blocks), int) if log is None else log[part.blocks.first])
        blocks.append(count + block)
        rows.append((slope * inverse[:, None], share, white))
        count += len(part.blocks)
    log_of, block = np.concatenate(logs), np.concatenate(blocks)
    slope, share, white = (np.concatenate(one) for one in zip(*rows, strict=True))
    errors, here = _Linear(slope, share, block, count), np.zeros(slope.shape[1])
    half = CONFIDENCE * np.sqrt(errors.solved(np.ones(count, bool), here, white)[1])
    names = np.unique(log_of)
    solutions = [errors.solved(log_of == log, here, white) for log in names]
    moves, variances = _each(solutions)
    if (p_values(moves, variances) < LEVEL).any():
        for index, begin in enumerate(np.where(moves**2 > variances, moves, 0.0)):
            chosen = log_of == names[index]
            with suppress(ValueError):  # the model does not take these values
                nearer = white_at(begin)
                if (share * (log_density(nearer) - log_density(white))) @ chosen[block] > 0.0:
                    solutions[index] = errors.solved(chosen, begin, nearer)
        moves, variances = _each(solutions)
    between = half_widths_between(moves, variances)
    return Spreads(half, between, tuple(names.tolist()), moves, np.sqrt(variances))


_Solution = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class _Linear:
    """Whitened errors that are linear in the variables.

    Args:
        slope: their derivatives, (N, p).
        share: shares of the errors in the score, (N).
        block: index of the block of each error, (N).
        count: number of blocks.
    """

    slope: np.ndarray
    share: np.ndarray
    block: np.ndarray
    count: int

    def solved(self, chosen: np.ndarray, begin: np.ndarray, white: np.ndarray) -> _Solution:
        """The best values for some blocks alone.

        Args:
            chosen: which blocks count, (B).
            begin: a move of the variables, (p,).
            white: the errors there, (N).

        Returns:
            The move to the best values, its squared errors, and which values these blocks contain, each (p,).
        """
        own = chosen[self.block]
        slope, error, share, move = self.slope[own], white[own], self.share[own], np.zeros(self.slope.shape[1])
        for _ in range(REWEIGHTED):
            weight = share * weights(error + slope @ move)
            curvature = slope.T @ (weight[:, None] * slope)
            size = np.sqrt(np.diag(curvature))
            size[size == 0.0] = 1.0
            curvature = curvature / np.outer(size, size)
            bread = np.linalg.pinv(curvature, rcond=SINGULAR, hermitian=True)
            is_known = (np.diag(bread @ curvature) > KNOWN) & (chosen.sum() > len(size))
            bread = bread / np.outer(size, size)
            move = move - bread @ (slope.T @ (weight * (error + slope @ move)))
        left = error + slope @ move
        bread = bread * excess_of_weights(left, share)
        pulls = np.zeros((self.count, len(size)))
        np.add.at(pulls, self.block[own], slope * (share * weights(left) * left)[:, None])
        spare = chosen.sum() / max(1, chosen.sum() - len(size))
        return begin + move, np.maximum(np.diag(bread @ pulls.T @ pulls @ bread) * spare, 0.0), is_known


def _each(solutions: Sequence[_Solution]) -> tuple[np.ndarray, np.ndarray]:
    """The moves of each log, and their squared errors, infinite where the log does not contain the value, (logs, p)."""
    moves, variances, is_known = map(np.stack, zip(*solutions, strict=True))
    return moves, np.where(is_known, variances, np.inf)


def interval(parameter: Parameter, half_width: float) -> tuple[float, float]:
    """95 % interval of a fitted parameter, within its bounds."""
    low, high = parameter.bounds
    return float(max(low, parameter.value - half_width)), float(min(high, parameter.value + half_width))
