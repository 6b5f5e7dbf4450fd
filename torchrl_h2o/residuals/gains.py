"""What each candidate of a sweep could gain beside the present effects, by linear algebra."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from torchrl_h2o.effects import Armature, CatalogueEntry, Effect, JointDamping, JointFrictionLoss
from torchrl_h2o.likelihood import FEWEST, Difference, log_density
from torchrl_h2o.residuals.refit import REWEIGHTED, RIDGE, Variable
from torchrl_h2o.residuals.score import Predictions, fitted_scales
from torchrl_h2o.residuals.sweep import Direction
from torchrl_h2o.residuals.whitened import block_of, flat, weights, whitened

#: what every driven joint has, so that a machine may lack all of it
OF_JOINTS = (JointFrictionLoss, JointDamping, Armature)
START_SHARE = 0.02  # least share of a trial from which the values of every joint are fitted together
RESCALED = np.logspace(-3.0, 3.0, 7)  # factors that are tried on the variance of what the simulator leaves unexplained
GROUPS = 4  # groups of errors, each of which suggests a share of a candidate
REFINED = 4  # refinements of the share of one candidate
SLIGHT = 0.01  # gain of such a refinement, in nats a block, after which none follows
PAIRED = 24  # candidates of which two are tried together
LEAST_REST = 0.02  # share of the errors' change by a candidate that another one must leave, for both to be told apart
LEAST_NATS = 2.0  # estimated gain of all blocks with which one of several joints or motors has an effect of its own


@dataclass(frozen=True)
class Lead:
    """A candidate with its estimated gain: one effect, or the same effect on each of several joints or motors.

    Args:
        directions: the direction of each effect.
        shares: estimated share of each trial.
        gain: estimated gain of the score in nats a block, if the errors are linear in the effect.
        evidence: estimated evidence of the rows for the candidate.
    """

    directions: tuple[Direction, ...]
    shares: tuple[float, ...]
    gain: float
    evidence: float

    @property
    def names(self) -> frozenset[str]:
        """Names of the entries."""
        return frozenset(direction.entry.name for direction in self.directions)

    @property
    def factors(self) -> tuple[float, ...]:
        """Factors of the shares that are worth a simulation: as estimated, half of it, and the size of the trial."""
        return tuple(dict.fromkeys((1.0, 0.5, 1.0 / max(abs(share) for share in self.shares))))

    def beside(
        self,
        entries: Sequence[CatalogueEntry],
        effects: Sequence[Effect],
        factor: float,
        readjusted: Sequence[Effect] | None = None,
    ) -> tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]:
        """Present entries and effects with the candidate at a factor of its shares.

        Effects on each of several joints take the place of present ones of the same kind, and begin at their values.

        Args:
            entries: the present entries.
            effects: the present effects.
            factor: the factor.
            readjusted: the present effects with values readjusted to the candidate.
        """
        own = [direction.effect(factor * share) for direction, share in zip(self.directions, self.shares, strict=True)]
        kept = list(zip(entries, effects if readjusted is None else readjusted, strict=True))
        if len(own) > 1:
            kinds = {type(one) for one in own}
            alone = {entry.name for entry in entries if entry.name in self.names}
            for entry, effect in zip(entries, effects, strict=True):
                own = [
                    summed(one, effect)
                    if type(one) is type(effect) and (entry.name == d.entry.name or entry.name not in alone)
                    else one
                    for d, one in zip(self.directions, own, strict=True)
                ]
            kept = [pair for pair in kept if type(pair[1]) not in kinds]
        return (
            (*(entry for entry, _ in kept), *(direction.entry for direction in self.directions)),
            (*(effect for _, effect in kept), *own),
        )


def summed(effect: Effect, present: Effect) -> Effect:
    """An effect with the parameters of another one of its kind in it."""
    values = {}
    for name, parameter in effect.parameters.items():
        other = present.parameters[name].value
        value = parameter.value * other if parameter.neutral == 1.0 else parameter.value + other - parameter.neutral
        values[name] = float(np.clip(value, *parameter.bounds))
    return effect.with_parameters(values)


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of candidates beside effects that are readjusted, for the errors at hand.

    Args:
        white: whitened errors, (N).
        inverse: inverse scales of the errors, (N).
        share: shares of the errors in the score, (N).
        beside: changes by the values of the present effects, whitened, (N, p).
        block: index of the block of each error, (N).
        group: index of the kind of windows, the horizon and the reading of each error, (N).
        unexplained: share of the variance of each error that is fitted to the errors of its group, (N).
    """

    white: np.ndarray
    inverse: np.ndarray
    share: np.ndarray
    beside: np.ndarray
    block: np.ndarray
    group: np.ndarray
    unexplained: np.ndarray

    @classmethod
    def of(cls, predictions: Predictions, errors: Sequence[np.ndarray], slopes: np.ndarray | None = None) -> Gains:
        """Prepares the gains for errors (as :meth:`Predictions.errors`), beside present effects with slopes (N, p)."""
        scales = fitted_scales(predictions, errors)
        white, inverse, share = whitened(predictions, errors, scales)
        columns = np.zeros((len(white), 0)) if slopes is None else slopes * inverse[:, None]
        groups = _groups(errors)
        fitted = flat([np.broadcast_to(scale, one.shape) for scale, one in zip(scales, errors, strict=True)])
        return cls(white, inverse, share, columns, block_of(predictions), groups, fitted * inverse**2)

    @property
    def slopes(self) -> np.ndarray:
        """Changes by the values of the present effects, (N, p), in spreads."""
        return self.beside / self.inverse[:, None]

    @cached_property
    def _rescaled(self) -> tuple[np.ndarray, np.ndarray]:
        """Inverse roots of the variances that are tried, in those at hand, (K, N), and their logarithms."""
        root = 1.0 / np.sqrt(1.0 + (RESCALED[:, None] - 1.0) * self.unexplained)
        return root, np.log(root)

    @property
    def score(self) -> float:
        """Mean score of the blocks with the present effects, in nats; see :meth:`Predictions.score`."""
        return float(self.share @ (log_density(self.white) + np.log(self.inverse))) / self.num_blocks

    @property
    def num_blocks(self) -> int:
        """Number of blocks."""
        return int(self.block.max()) + 1

    @cached_property
    def weight(self) -> np.ndarray:
        """Weights of the errors with which half their sum of squares has the gradient of the score, (N)."""
        return self.share * weights(self.white)

    def leads(self, directions: Sequence[Direction]) -> list[Lead]:
        """The candidates in descending order of their gain: each direction, and those of each kind together."""
        columns = self._free_of_present(directions)
        found = [lead for one, column in zip(directions, columns, strict=True) if (lead := self._alone(one, column))]
        kinds: dict[tuple, dict[str, int]] = {}
        for index, one in enumerate(directions):
            if one.element is not None:
                kinds.setdefault((type(one.entry.effect), one.sign), {}).setdefault(one.entry.name, index)
        for own in (list(members.values()) for members in kinds.values()):
            if len(own) > 1 and (lead := self._together([directions[i] for i in own], [columns[i] for i in own])):
                found.append(lead)
        return sorted(found, key=lambda lead: -lead.gain)

    def of_joints(self, directions: Sequence[Direction]) -> Lead | None:
        """Friction, damping and rotor of every joint together; None if the sweep has none."""
        own = {
            one.entry.name: one for one in directions if type(one.entry.effect) in OF_JOINTS and one.element is not None
        }
        chosen = [one for one in own.values() if one.sign]
        if len(chosen) < 2:
            return None
        columns = self._free_of_present(chosen)
        shares, _ = self._solved(chosen, columns)
        shares = np.where(np.abs(shares) < START_SHARE, START_SHARE, shares)
        return self._lead(tuple(chosen), shares, np.stack(columns, axis=1) @ shares)

    def pairs(self, leads: Sequence[Lead]) -> list[Lead]:
        """Two candidates together, in descending order of their gain, if each adds to what the other one gains.

        Each of two effects may explain nothing without the other, or less than a third effect that stands for both.

        Args:
            leads: candidates of one direction, in descending order of their gain.
        """
        chosen = [lead for lead in leads if len(lead.directions) == 1][:PAIRED]
        directions = [lead.directions[0] for lead in chosen]
        matrix = np.stack(self._free_of_present(directions), axis=1) if chosen else np.zeros((len(self.white), 0))
        weighted = self.weight[:, None] * matrix
        gram, pull = weighted.T @ matrix, weighted.T @ self.white
        square = np.maximum(np.diag(gram), 1e-300)
        first, second = np.triu_indices(len(chosen), 1)
        rest = 1.0 - gram[first, second] ** 2 / (square[first] * square[second])  # of one beside the other
        beside = pull[second] - pull[first] * gram[first, second] / square[first]
        gains = pull[first] ** 2 / square[first] + beside**2 / (square[second] * np.maximum(rest, 1e-300))
        gains[rest < LEAST_REST] = -math.inf
        best = np.argsort(-gains)[: 2 * PAIRED]
        found = []
        for i, j in ((first[k], second[k]) for k in best if gains[k] > 0.0):
            lead = self._together([directions[i], directions[j]], [matrix[:, i], matrix[:, j]])
            if lead is not None and lead.gain > max(chosen[i].gain, chosen[j].gain):
                found.append(lead)
        return sorted(found, key=lambda lead: -lead.gain)

    def evidence_if_there(self, direction: Direction) -> float:
        """Evidence of the rows for an effect if it were there at its trial beside the present errors."""
        return -self._evidence(self._gains(direction.change * self.inverse))

    @cached_property
    def _inverse(self) -> np.ndarray:
        """Inverse curvature of the score by the variables of the present effects, (p, p)."""
        gram = self.beside.T @ (self.weight[:, None] * self.beside)
        return np.linalg.pinv(gram + np.diag(RIDGE * np.diag(gram) + 1e-12))

    def readjusted(self, dropped: Collection[int], variables: Sequence[Variable]) -> tuple[np.ndarray, float]:
        """Moves of all variables, (p), that take some effects to neutral, and the loss in nats if errors are linear.

        A wave is neutral without its coefficient, whatever its frequency. The loss is infinite if an effect has no
        value that can be moved to neutral, such as a limit that is never reached.
        """
        own = [i for i, one in enumerate(variables) if one.effect in dropped and math.isfinite(one.to_neutral)]
        if {variables[index].effect for index in own} != set(dropped):
            return np.zeros(len(variables)), math.inf
        moves = np.array([variables[index].to_neutral for index in own])
        pull = np.linalg.pinv(self._inverse[np.ix_(own, own)]) @ moves
        return self._inverse[:, own] @ pull, float(moves @ pull)

    def evidence_for(self, moves: np.ndarray) -> float:
        """Evidence for present effects that moves of the variables (p) take to neutral, if errors are linear."""
        return -self._evidence(self._gains(self.beside @ moves))

    @cached_property
    def _readjust(self) -> np.ndarray:
        """(p, N): moves of the values of the present effects that make up for a whitened change."""
        weighted = self.weight[:, None] * self.beside
        gram = weighted.T @ self.beside
        return -np.linalg.pinv(gram + 1e-9 * np.diag(np.diag(gram))) @ weighted.T

    def _free_of_present(self, directions: Sequence[Direction]) -> list[np.ndarray]:
        """Whitened changes, each after the present effects have been readjusted."""
        columns = [direction.change * self.inverse for direction in directions]
        return [column + self.beside @ (self._readjust @ column) for column in columns]

    def _alone(self, direction: Direction, column: np.ndarray) -> Lead | None:
        def least_squares(weight: np.ndarray) -> float:
            return float(-(weight * self.white) @ column / max((weight * column) @ column, 1e-300))

        gains: dict[float, float] = {}

        def gain(share: float) -> float:
            share = float(np.clip(share, *direction.shares))
            return gains.setdefault(share, float(self._gains(share * column).sum()))

        first = least_squares(self.weight)
        for share in (first, math.copysign(1.0, first), *self._shares_of_groups(column)):
            gain(share)
        for _ in range(REFINED):
            best = max(gains, key=gains.__getitem__)
            if gain(least_squares(self._weight_at(best * column))) < gains[best] + SLIGHT * self.num_blocks:
                break
        best = max(gains, key=gains.__getitem__)
        return self._lead((direction,), np.array([best]), best * column) if best and gains[best] > 0.0 else None

    def _shares_of_groups(self, column: np.ndarray) -> list[float]:
        """The shares that explain most of the errors of one group each, for the few groups with the largest gain."""

        def sums(values: np.ndarray) -> np.ndarray:
            return np.bincount(self.group, self.weight * values)

        both, square, before = sums(self.white * column), sums(column**2), sums(self.white**2)
        shares = -both / np.maximum(square, 1e-300)
        left = np.maximum(before + shares * both, 1e-3 * before + 1e-300)
        gains = np.bincount(self.group, self.share) * np.log(np.maximum(before, 1e-300) / left)
        return shares[np.argsort(-gains)[:GROUPS]].tolist()

    def _together(self, directions: Sequence[Direction], columns: Sequence[np.ndarray]) -> Lead | None:
        """Directions of one kind, each with a share of its own, as far as they gain something."""
        shares, gram = self._solved(directions, columns)
        lost = 0.5 * shares**2 / np.diag(np.linalg.pinv(gram + 1e-12 * np.eye(len(gram))))  # without each, in nats
        acting = np.flatnonzero(lost > LEAST_NATS).tolist()
        if len(acting) < len(columns):
            kept = [directions[i] for i in acting], [columns[i] for i in acting]
            return self._together(*kept) if len(acting) > 1 else None
        return self._lead(tuple(directions), shares, np.stack(columns, axis=1) @ shares)

    def _solved(self, directions: Sequence[Direction], columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The shares with the best score, within their bounds, and the curvature of the score."""
        matrix = np.stack(columns, axis=1)
        low, high = np.transpose([one.shares for one in directions])
        shares, moved, gram = np.zeros(len(columns)), self.white, np.eye(len(columns))
        for _ in range(REWEIGHTED):
            root = np.sqrt(self.share * weights(moved))
            scaled = root[:, None] * matrix
            gram = scaled.T @ scaled
            factor = np.linalg.cholesky(gram + np.diag(RIDGE * np.diag(gram) + 1e-12)).T
            pull = -scaled.T @ (root * self.white)
            shares = lsq_linear(factor, np.linalg.solve(factor.T, pull), bounds=(low, np.maximum(high, low + 1e-9))).x
            moved = self.white + matrix @ shares
        return shares, gram

    def _lead(self, directions: tuple[Direction, ...], shares: np.ndarray, change: np.ndarray) -> Lead:
        # errors of the estimate raise the likeliest variances, which all blocks share, also those without an error
        gains, at_hand = self._gains(change), (log_density(self.white + change) - self._present) * self.share
        evidence = max(self._evidence(gains), self._evidence(at_hand))
        return Lead(directions, tuple(map(float, shares)), float(gains.sum()) / self.num_blocks, evidence)

    def moves_beside(self, lead: Lead) -> np.ndarray:
        """Estimated moves of the values of the present effects beside a candidate, (p)."""
        change = sum(share * one.change for one, share in zip(lead.directions, lead.shares, strict=True))
        return self._readjust @ (change * self.inverse)

    @cached_property
    def _present(self) -> np.ndarray:
        """Log density of the errors without a change, (N)."""
        return log_density(self.white)

    def _gains(self, change: np.ndarray) -> np.ndarray:
        """Gain of each error by a change, (N), with the variance of each group that makes it likeliest."""
        return (self._likeliest(change)[0] - self._present) * self.share

    def _evidence(self, gains: np.ndarray) -> float:
        """Evidence for gains of the errors, (N), paired over blocks."""
        difference = Difference(np.bincount(self.block, gains))
        return difference.evidence if difference.acting >= FEWEST else float(difference.by_block.sum())

    def _weight_at(self, change: np.ndarray) -> np.ndarray:
        """Weights of the errors as in :attr:`weight`, after a change and with the variances that are likeliest then."""
        root = self._likeliest(change)[1]
        return self.share * weights((self.white + change) * root) * root**2

    def _likeliest(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log density of the errors after a change, and the inverse roots of the likeliest variances, each (N)."""
        root, log_root = self._rescaled
        density = log_density((self.white + change) * root) + log_root
        likely = np.stack([np.bincount(self.group, one * self.share) for one in density])
        choice = likely.argmax(0)[self.group], np.arange(len(self.group))
        return density[choice], root[choice]


def _groups(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Index of the kind of windows, the horizon and the reading of each error, (N)."""
    found, count = [], 0
    for one in errors:
        groups = np.arange(count, count + one[0].size).reshape(one[0].shape)
        found.append(np.broadcast_to(groups, one.shape))
        count += one[0].size
    return flat(found)
