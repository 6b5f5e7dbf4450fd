"""Simple physics beside a simulation, and what it leaves of the motion in windows that its fit has not used."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import lsq_linear

from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.likelihood import Difference, log_density

USUAL_GAINS = (0.4, 2.5)  # of motors whose units, signs and columns are right
SMALL_ZERO = 0.1  # rad; a larger error of an angle's zero is a finding
FOLD = 5  # successive windows that are fitted, or left out of a fit, together
ROBUST = 3.0  # usual deviations from which a window loses weight, as in Huber's loss
BETTER = 0.6  # share of what is left of one velocity at least that a hypothesis leaves at most
EVIDENCE = math.log(100.0)  # nats: a likelihood ratio of 100, as in the search for effects
MEDIAN = 0.6745  # median size of a normal variable, in standard deviations
MEDIAN_OF_T = 0.524  # the same of Student's t of the log density
DIVERGED = 3.0  # error of a simulation that diverges, and the largest that counts, in usual changes
LESS = 0.02  # usual changes of a velocity by which it leaves less at least
LEAST = 0.005  # the same where evidence is enough


@dataclass(frozen=True, eq=False)
class Explained:
    """What simple physics explains of the changes of the velocities.

    Args:
        left: errors in windows that the fit has not used, in usual changes of each velocity, (W, m); NaN where the
            simulation is not known.
        gains: of the actions in the two fits, (2, nu).
        zeros: errors of the zeros of the positions in the two fits, (2, pairs).
    """

    left: np.ndarray
    gains: np.ndarray
    zeros: np.ndarray

    @property
    def sizes(self) -> np.ndarray:
        """Sizes of the errors, at most ``DIVERGED``, (W, m)."""
        return np.minimum(np.nan_to_num(np.abs(self.left), nan=DIVERGED), DIVERGED)

    @cached_property
    def shares(self) -> np.ndarray:
        """Usual share of the change of each velocity that is left, (m,)."""
        return np.median(self.sizes, axis=0)

    @property
    def share(self) -> float:
        """Its mean over the velocities."""
        return float(self.shares.mean())

    def evidence(self, other: Explained) -> float:
        """Evidence for this against another explanation, in nats, paired over groups of successive windows.

        Errors have Student's distribution with the scale that they show.
        """
        gained = self._log_density - other._log_density
        groups = np.array_split(gained, max(1, len(gained) // FOLD))
        return Difference(np.array([group.mean() for group in groups])).evidence

    @cached_property
    def _log_density(self) -> np.ndarray:
        scale = np.maximum(self.shares / MEDIAN_OF_T, 1e-6)
        return (log_density(np.nan_to_num(self.left, nan=DIVERGED) / scale) - np.log(scale)).sum(1)

    def explains_more(self, other: Explained, enough: float = BETTER) -> bool:
        """Whether much less is left than another explanation leaves, of one velocity at least and in total.

        Args:
            other: the other explanation, of the same windows.
            enough: share of what is left of one velocity that this may leave; 1 if any share is enough.
        """
        least = LESS if enough < 1.0 else LEAST
        helps = (self.shares < enough * other.shares) & (other.shares - self.shares > least)
        return bool(helps.any()) and self.share < other.share and self.evidence(other) > EVIDENCE


def explain(
    response: Response,
    *,
    gains: tuple[float, float] = USUAL_GAINS,
    zeros: float = SMALL_ZERO,
) -> Explained:
    """Fits simple physics to every second group of windows, and predicts the others with it.

    The physics are gains of the motors, small errors of the zeros of angles, and dry friction, viscous friction, a
    spring and a constant force of each joint.

    Args:
        response: simulated windows.
        gains: bounds of the gains.
        zeros: largest error of the zero of an angle, in rad.
    """
    columns = np.concatenate([response.by_gain, response.by_zero, friction_responses(response)], -1)
    count, pairs = response.by_gain.shape[-1], response.log.pairs
    bounds = np.tile([[-np.inf], [np.inf]], columns.shape[-1])
    bounds[:, :count] = np.array(gains)[:, None]
    for index, pair in enumerate(pairs):
        bounds[:, count + index] = (-zeros, zeros) if pair.angle else (-np.inf, np.inf)
    usable = np.isfinite(response.target) & np.isfinite(columns).all(-1)
    target = np.where(usable, response.target, 0.0) / response.scale
    columns = np.where(usable[..., None], columns, 0.0) / response.scale[:, None]
    left, values = np.full(target.shape, np.nan), []
    second = np.arange(len(target)) // FOLD % 2 == 1
    for fold in (second, ~second):
        values.append(_fitted(target[~fold], columns[~fold], usable[~fold], bounds))
        left[fold] = target[fold] - columns[fold] @ values[-1]
    both = np.array(values)
    return Explained(np.where(usable, left, np.nan), both[:, :count], both[:, count : count + len(pairs)])


def friction_responses(response: Response) -> np.ndarray:
    """Responses to dry and viscous friction, a spring and a constant force of each joint, (W, m, 4 m)."""
    velocity = response.before + 0.5 * response.change
    spread = np.maximum(velocity.std(0), 1e-12)
    terms = [np.tanh(velocity / (0.1 * spread)), velocity / spread, np.ones_like(velocity)]
    position = np.zeros_like(velocity)
    for index, pair in enumerate(response.log.pairs):  # the first velocities are those of the pairs
        position[:, index] = response.states[:, pair.coordinate] - response.states[:, pair.coordinate].mean()
    terms.append(position)
    return np.concatenate([response.by_force * term[:, None] for term in terms], axis=-1)


def _fitted(target: np.ndarray, columns: np.ndarray, usable: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Least squares of (W, m) on (W, m, P) within bounds (2, P), with Huber's weights, reweighted three times."""
    x, y = columns.reshape(-1, columns.shape[-1]), target.ravel()
    size = np.sqrt((x**2).mean(0)) + 1e-12
    x, weights, values = x / size, usable.astype(float), np.zeros(len(size))
    for _ in range(4):
        weighted = x * weights.reshape(-1, 1)
        root = cholesky(weighted.T @ x + 1e-7 * len(x) * np.eye(len(size)))
        wanted = solve_triangular(root, weighted.T @ y, trans=1)
        values = solve_triangular(root, wanted)
        if ((values < bounds[0] * size) | (values > bounds[1] * size)).any():
            values = lsq_linear(root, wanted, bounds * size, method="bvls").x
        left = np.where(usable, np.abs((y - x @ values).reshape(target.shape)), DIVERGED)
        limit = ROBUST * np.maximum(np.median(left, axis=0) / MEDIAN, 1e-9)
        weights = np.where(usable, np.minimum(1.0, limit / np.maximum(left, 1e-12)), 0.0)
    return values / size
