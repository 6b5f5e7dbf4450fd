"""One sweep over a catalogue: how the errors change with each candidate, and what it could gain, by linear algebra."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear

from torchrl_h2o.effects import (
    ActionBacklash,
    ActionDeadBand,
    ActionDelay,
    ActionLag,
    ActionSaturation,
    Armature,
    CatalogueEntry,
    Effect,
    JointDamping,
    JointFrictionLoss,
    JointRange,
    ObservationDelay,
)
from torchrl_h2o.residuals.elements import elements
from torchrl_h2o.residuals.model_bounds import lowest_value
from torchrl_h2o.residuals.refit import REWEIGHTED, RIDGE, Variable, block_of, flat, weights, whitened
from torchrl_h2o.residuals.score import FEWEST, Difference, Predictions, fitted_scales
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.start_states import log_density

#: effects that act otherwise at each size, so that every trial is simulated
NOT_LINEAR = (ActionBacklash, ActionDeadBand, ActionDelay, ActionLag, ActionSaturation, JointRange, ObservationDelay)
#: what every driven joint has, so that a machine may lack all of it
OF_JOINTS = (JointFrictionLoss, JointDamping, Armature)
START_SHARE = 0.02  # least share of a trial from which the values of every joint are fitted together
LEAST_NATS = 2.0  # estimated gain of all blocks with which one of several joints or motors has an effect of its own
MOST_SHARE = 4.0  # largest move along a candidate's direction, in moves of its trial


@dataclass(frozen=True, eq=False)
class Direction:
    """A candidate: an entry of the catalogue and one of its trials, along which the errors were simulated.

    Args:
        entry: the entry.
        trial: values of the trial.
        change: change of the errors at the trial, (N), in spreads.
        shares: least and largest share of the trial that may be tried.
        element: index of the joint or the motor, for an effect of one parameter on a single one.
    """

    entry: CatalogueEntry
    trial: Mapping[str, float]
    change: np.ndarray = field(repr=False)
    shares: tuple[float, float] = (-MOST_SHARE, MOST_SHARE)
    element: int | None = None

    @property
    def sign(self) -> bool:
        """Whether the trial is above the neutral value."""
        (name,) = self.entry.fitted[:1]
        return bool(self.trial[name] > self.entry.effect.parameters[name].neutral)

    def effect(self, share: float) -> Effect:
        """The effect at a share of the trial; powers of a factor. A limit that is never reached has only its trial."""
        values = {}
        for name, value in self.trial.items():
            parameter = self.entry.effect.parameters[name]
            neutral, (low, high) = parameter.neutral, parameter.bounds
            if not math.isfinite(neutral):
                values[name] = value
            elif neutral == 1.0 and value > 0.0:
                values[name] = float(np.clip(value**share, low, high))
            else:
                values[name] = float(np.clip(neutral + share * (value - neutral), low, high))
        return self.entry.effect.with_parameters(values)


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

    def beside(
        self, entries: Sequence[CatalogueEntry], effects: Sequence[Effect], factor: float
    ) -> tuple[tuple[CatalogueEntry, ...], tuple[Effect, ...]]:
        """Present entries and effects with the candidate at a factor of its shares.

        Effects on each of several joints take the place of present ones of the same kind, and begin at their values.
        """
        own = [direction.effect(factor * share) for direction, share in zip(self.directions, self.shares, strict=True)]
        kept = list(zip(entries, effects, strict=True))
        if len(own) > 1:
            kinds = {type(one) for one in own}
            alone = {entry.name for entry, _ in kept if entry.name in self.names}
            for entry, effect in kept:
                own = [
                    _sum(one, effect)
                    if type(one) is type(effect) and (entry.name == d.entry.name or entry.name not in alone)
                    else one
                    for d, one in zip(self.directions, own, strict=True)
                ]
            kept = [pair for pair in kept if type(pair[1]) not in kinds]
        return (
            (*(entry for entry, _ in kept), *(direction.entry for direction in self.directions)),
            (*(effect for _, effect in kept), *own),
        )


def _sum(effect: Effect, present: Effect) -> Effect:
    """An effect of one parameter with that of another one of its kind in it."""
    values = {}
    for name, parameter in effect.parameters.items():
        other = present.parameters[name].value
        value = parameter.value * other if parameter.neutral == 1.0 else parameter.value + other - parameter.neutral
        values[name] = float(np.clip(value, *parameter.bounds))
    return effect.with_parameters(values)


def sweep(
    predictions: Predictions,
    entries: Sequence[CatalogueEntry],
    beside: Sequence[Effect] = (),
    advance: Callable[[], object] = lambda: None,
) -> list[Direction]:
    """Simulates each candidate once, or once for each trial where its errors are not linear in its size.

    An effect on several joints or motors is the sum of those on each, so it is not simulated.

    Args:
        predictions: predictions of the simulator.
        entries: the catalogue.
        beside: effects that the simulator has already.
        advance: called after each entry.
    """
    before, simulation = flat(predictions.errors(beside)), predictions.record.simulation
    alone = _alone(entries, simulation)
    found: dict[str, list[Direction]] = {}
    shared: list[tuple[CatalogueEntry, list[CatalogueEntry]]] = []
    for entry in entries:
        advance()
        own = elements(entry.effect, simulation)
        parts = [alone.get((type(entry.effect), one)) for one in own]
        if entry.effect.random:
            continue
        if len(own) > 1 and all(parts) and not isinstance(entry.effect, JointRange):
            shared.append((entry, [part for part in parts if part is not None]))
            continue
        for trial in _simulated_trials(entry):
            try:
                change = flat(predictions.errors([*beside, entry.effect.with_parameters(trial)])) - before
            except ValueError:
                continue
            if np.abs(change).max() > 0.0:
                shares = _shares(entry, trial, simulation, beside)
                alone_on = own[0] if len(own) == 1 == len(trial) and not isinstance(entry.effect, JointRange) else None
                direction = Direction(entry, trial, change.astype(np.float32), shares, alone_on)
                found.setdefault(entry.name, []).append(direction)
    for entry, parts in shared:
        if directions := _together(entry, [found.get(part.name, []) for part in parts]):
            found[entry.name] = directions
    return [direction for directions in found.values() for direction in directions]


def _alone(entries: Sequence[CatalogueEntry], simulation: Simulation) -> dict[tuple[type, int], CatalogueEntry]:
    """The entries that act on a single joint or motor, by kind and index."""
    found = {}
    for entry in entries:
        own = elements(entry.effect, simulation)
        if len(own) == 1:
            found[type(entry.effect), own[0]] = entry
    return found


def _simulated_trials(entry: CatalogueEntry) -> list[Mapping[str, float]]:
    """The trials to simulate: all if the errors are not linear; otherwise the least factor on either side of 1, or the
    last trial along each line through the neutral values."""
    if isinstance(entry.effect, NOT_LINEAR):
        return list(entry.trials)
    neutral = {name: parameter.neutral for name, parameter in entry.effect.parameters.items()}
    if len(entry.fitted) == 1 and neutral[entry.fitted[0]] == 1.0:
        (name,) = entry.fitted
        by_size = sorted(entry.trials, key=lambda trial: -abs(math.log(trial[name])))
        return list({trial[name] > 1.0: trial for trial in by_size}.values())
    lines = {}
    for trial in entry.trials:
        moves = np.array([value - neutral[name] for name, value in trial.items()])
        largest = moves[np.abs(moves).argmax()]
        line = tuple(np.round(moves / largest, 6))
        if largest > 0.0 or line not in lines:  # the opposite direction is the same line
            lines[line] = trial
    return list(lines.values())


def _together(entry: CatalogueEntry, parts: Sequence[Sequence[Direction]]) -> list[Direction]:
    """Directions of an effect on several elements from those on each of them."""
    if not all(parts) or len(entry.fitted) != 1:
        return []
    (name,), found = entry.fitted, []
    neutral = entry.effect.parameters[name].neutral

    def moved(value: float) -> float:
        return math.log(value) if neutral == 1.0 and value > 0.0 else value - (neutral if math.isfinite(neutral) else 0)

    for index in range(min(map(len, parts))):
        ones = [part[index] for part in parts]
        trial = {name: float(np.median([one.trial[name] for one in ones]))}
        size = moved(trial[name])
        if size == 0.0 or any(moved(one.trial[name]) == 0.0 for one in ones):
            continue
        change = np.sum([one.change * np.float32(size / moved(one.trial[name])) for one in ones], axis=0)
        least = max(one.shares[0] * moved(one.trial[name]) / size for one in ones)
        found.append(Direction(entry, trial, change, (max(least, -MOST_SHARE), MOST_SHARE)))
    return found


def _shares(
    entry: CatalogueEntry, trial: Mapping[str, float], simulation: Simulation, beside: Sequence[Effect]
) -> tuple[float, float]:
    """Shares of a trial at which the errors are about linear and the model accepts the effect."""
    if isinstance(entry.effect, NOT_LINEAR):
        return 0.0, 1.5
    least = lowest_value(entry.effect, simulation.model, beside)
    if not math.isfinite(least):
        return -MOST_SHARE, MOST_SHARE
    (value,) = trial.values()  # friction, damping, rotor and stiffness have one parameter, whose neutral value is zero
    ends = sorted((least / value, math.copysign(MOST_SHARE, value) if value < 0.0 else MOST_SHARE))
    return max(ends[0], -MOST_SHARE), min(ends[1], MOST_SHARE)


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of candidates beside effects that are readjusted, for the errors at hand.

    Args:
        white: whitened errors, (N).
        inverse: inverse scales of the errors, (N).
        share: shares of the errors in the score, (N).
        beside: changes by the values of the present effects, whitened, (N, p).
        block: index of the block of each error, (N).
    """

    white: np.ndarray
    inverse: np.ndarray
    share: np.ndarray
    beside: np.ndarray
    block: np.ndarray

    @classmethod
    def of(cls, predictions: Predictions, errors: Sequence[np.ndarray], beside: Sequence[np.ndarray]) -> Gains:
        """Prepares the gains for errors (as :meth:`Predictions.errors`), beside changes (N) of present effects."""
        white, inverse, share = whitened(predictions, errors, fitted_scales(predictions, errors))
        columns = np.stack([change * inverse for change in beside], 1) if beside else np.zeros((len(white), 0))
        return cls(white, inverse, share, columns, block_of(predictions))

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
        return self._lead(tuple(chosen), tuple(map(float, shares)), np.stack(columns, axis=1) @ shares)

    def evidence_if_there(self, direction: Direction) -> float:
        """Evidence of the rows for an effect if it were there at its trial beside the present errors."""
        return -self._evidence(direction.change * self.inverse)

    def least_needed(self, variables: Sequence[Variable]) -> list[tuple[int, float]]:
        """Present effects in the order in which they may be dropped, with the evidence for each beside the later ones.

        The others are readjusted; the errors are taken as linear in all variables.
        """
        moves = np.array([one.to_neutral for one in variables])
        weight = self.share * weights(self.white)
        gram = self.beside.T @ (weight[:, None] * self.beside)
        inverse = np.linalg.pinv(gram + np.diag(RIDGE * np.diag(gram) + 1e-12))
        of_effect: dict[int, list[int]] = {}
        for index, one in enumerate(variables):
            of_effect.setdefault(one.effect, []).append(index)
        found: list[tuple[int, float]] = []
        dropped: list[int] = []
        before = np.zeros(len(self.white))
        while of_effect:

            def lost(effect: int, dropped: Sequence[int] = tuple(dropped)) -> float:
                own = [*dropped, *of_effect[effect]]
                with np.errstate(invalid="ignore"):
                    loss = moves[own] @ np.linalg.pinv(inverse[np.ix_(own, own)]) @ moves[own]
                return float(loss) if math.isfinite(loss) else math.inf

            effect = min(of_effect, key=lost)
            own = [*dropped, *of_effect[effect]]
            if not np.isfinite(moves[own]).all():
                found += [(other, math.inf) for other in of_effect]
                break
            change = self.beside @ (inverse[:, own] @ (np.linalg.pinv(inverse[np.ix_(own, own)]) @ moves[own]))
            found.append((effect, -self._evidence(change, before)))
            dropped, before = own, change
            del of_effect[effect]
        return found

    def _free_of_present(self, directions: Sequence[Direction]) -> list[np.ndarray]:
        """Whitened changes, each after the present effects have been readjusted."""
        weight, found = self.share * weights(self.white), []
        weighted = weight[:, None] * self.beside
        gram = weighted.T @ self.beside
        solve = np.linalg.pinv(gram + 1e-9 * np.diag(np.diag(gram))) if len(gram) else gram
        for direction in directions:
            column = direction.change * self.inverse
            found.append(column - self.beside @ (solve @ (weighted.T @ column)) if len(gram) else column)
        return found

    def _alone(self, direction: Direction, column: np.ndarray) -> Lead | None:
        weight = self.share * weights(self.white)
        best = -(weight * self.white) @ column / max((weight * column) @ column, 1e-300)
        low, high = direction.shares
        shares = [
            float(np.clip(share, low, high)) for share in (best, 2.0 * best, 0.5 * best, math.copysign(1.0, best))
        ]
        gains = [self._gain(share * column) for share in shares]
        most = int(np.argmax(gains))
        return self._lead((direction,), (shares[most],), shares[most] * column) if gains[most] > 0.0 else None

    def _together(self, directions: Sequence[Direction], columns: Sequence[np.ndarray]) -> Lead | None:
        """Directions of one kind, each with a share of its own, as far as they gain something."""
        shares, gram = self._solved(directions, columns)
        lost = 0.5 * shares**2 / np.diag(np.linalg.pinv(gram + 1e-12 * np.eye(len(gram))))  # without each, in nats
        acting = np.flatnonzero(lost > LEAST_NATS)
        if len(acting) < len(columns):
            kept = [directions[i] for i in acting], [columns[i] for i in acting]
            return self._together(*kept) if len(acting) > 1 else None
        return self._lead(tuple(directions), tuple(map(float, shares)), np.stack(columns, axis=1) @ shares)

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

    def _lead(self, directions: tuple[Direction, ...], shares: tuple[float, ...], change: np.ndarray) -> Lead:
        return Lead(directions, shares, self._gain(change) / (self.block.max() + 1), self._evidence(change))

    def _gain(self, change: np.ndarray) -> float:
        return float((log_density(self.white + change) - log_density(self.white)) @ self.share)

    def _evidence(self, change: np.ndarray, before: np.ndarray | float = 0.0) -> float:
        by_error = (log_density(self.white + change) - log_density(self.white + before)) * self.share
        difference = Difference(np.bincount(self.block, by_error))
        return difference.evidence if difference.acting >= FEWEST else float(difference.by_block.sum())
