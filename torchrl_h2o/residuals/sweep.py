"""One sweep over a catalogue: how the errors change with each candidate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_h2o.effects import (
    ActionBacklash,
    ActionDeadBand,
    ActionDelay,
    ActionLag,
    ActionSaturation,
    CatalogueEntry,
    Effect,
    GearPlay,
    JointRange,
    ObservationDelay,
    ServoDeadBand,
    TorqueSpeedLine,
)
from torchrl_h2o.residuals.elements import elements
from torchrl_h2o.residuals.model_bounds import lowest_value
from torchrl_h2o.residuals.score import Predictions
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.whitened import flat

#: effects that act otherwise at each size, so that every trial is simulated
NOT_LINEAR = (
    *(ActionBacklash, ActionDeadBand, ActionDelay, ActionLag, ActionSaturation, JointRange, ObservationDelay),
    *(GearPlay, ServoDeadBand, TorqueSpeedLine),
)
SMOOTH = (ActionDelay, ActionLag, ObservationDelay)  # of these, those whose errors are linear in a small size
FAR = 2.0  # factor beyond which a trial is simulated for itself, because the errors are not linear that far
LEAST_FACTOR = 0.1  # least factor that a share of a trial stands for, if the trial is above it
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
        """The effect at a share of the trial. A limit that is never reached has only its trial."""
        values = {}
        for name, value in self.trial.items():
            parameter = self.entry.effect.parameters[name]
            neutral, (low, high) = parameter.neutral, parameter.bounds
            if not math.isfinite(neutral):
                values[name] = value
            elif neutral == 1.0 and value > 0.0:
                scaled = value**share if isinstance(self.entry.effect, NOT_LINEAR) else 1.0 + share * (value - 1.0)
                values[name] = float(np.clip(max(scaled, min(value, LEAST_FACTOR)), low, high))
            else:
                values[name] = float(np.clip(neutral + share * (value - neutral), low, high))
        return self.entry.effect.with_parameters(values)


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
        entries: the catalogue, without random effects.
        beside: effects that the simulator has already.
        advance: called after each entry.
    """
    quick, simulation = predictions.quick, predictions.record.simulation
    before = flat(quick.errors(beside))
    alone = alone_on(entries, simulation)
    found: dict[str, list[Direction]] = {}
    shared: list[tuple[CatalogueEntry, list[CatalogueEntry]]] = []
    for entry in entries:
        advance()
        own = elements(entry.effect, simulation)
        parts = [alone.get((type(entry.effect), one)) for one in own]
        if len(own) > 1 and all(parts) and not isinstance(entry.effect, JointRange):
            shared.append((entry, [part for part in parts if part is not None]))
            continue
        without_effect: set[tuple[bool, ...]] = set()
        for trial in _simulated_trials(entry):
            if _side(entry, trial) in without_effect:  # a smaller trial has none, either
                continue
            try:
                change = flat(quick.errors([*beside, entry.effect.with_parameters(trial)])) - before
            except ValueError:
                continue
            if np.abs(change).max() == 0.0:
                without_effect.add(_side(entry, trial))
            else:
                shares = _shares(entry, trial, simulation, beside)
                single = len(own) == 1 and len(trial) == 1 and not isinstance(entry.effect, JointRange)
                direction = Direction(entry, trial, change.astype(np.float32), shares, min(own) if single else None)
                found.setdefault(entry.name, []).append(direction)
    for entry, parts in shared:
        if directions := _together(entry, [found.get(part.name, []) for part in parts]):
            found[entry.name] = directions
    return [direction for directions in found.values() for direction in reversed(directions)]


def alone_on(
    entries: Sequence[CatalogueEntry],
    simulation: Simulation,
    of: Callable[[Effect, Simulation], Sequence[int]] = elements,
) -> dict[tuple[type, int], CatalogueEntry]:
    """The entries that act on a single joint or motor, or on a single element by ``of``, by kind and index."""
    found = {}
    for entry in entries:
        own = of(entry.effect, simulation)
        if len(own) == 1:
            found[type(entry.effect), own[0]] = entry
    return found


def _simulated_trials(entry: CatalogueEntry) -> list[Mapping[str, float]]:
    """The trials to simulate, larger ones first: one along each line through the neutral values and each far factor,
    or, where the errors are not linear in the size, all. The least of three lags or delays is left out, because small
    ones are linear."""
    neutral = {name: parameter.neutral for name, parameter in entry.effect.parameters.items()}
    by_size: list[Mapping[str, float]] = sorted(entry.trials, key=lambda trial: -_size(entry, trial))
    if isinstance(entry.effect, NOT_LINEAR):
        return by_size[:-1] if isinstance(entry.effect, SMOOTH) and len(by_size) > 2 else by_size
    if len(entry.fitted) == 1 and neutral[entry.fitted[0]] == 1.0:
        return [*(trial for trial in by_size[:-1] if _is_far(entry, trial)), by_size[-1]]
    lines = {}
    for trial in entry.trials:
        moves = np.array([value - neutral[name] for name, value in trial.items()])
        moves = moves[np.isfinite(moves)]
        largest = moves[np.abs(moves).argmax()]
        fixed = (value for name, value in trial.items() if not math.isfinite(neutral[name]))
        line = (*fixed, *np.round(moves / largest, 6))
        if largest > 0.0 or line not in lines:  # the opposite direction is the same line
            lines[line] = trial
    return list(lines.values())


def _size(entry: CatalogueEntry, trial: Mapping[str, float]) -> float:
    """How far a trial is from neutral: that of a factor by its logarithm, that of a limit by its inverse."""
    (name, value), *_ = trial.items()
    neutral = entry.effect.parameters[name].neutral
    if not math.isfinite(neutral):
        return 1.0 / max(abs(value), 1e-300)
    return abs(math.log(value)) if neutral == 1.0 and value > 0.0 else abs(value - neutral)


def _is_far(entry: CatalogueEntry, trial: Mapping[str, float]) -> bool:
    """Whether a trial is a factor beyond ``FAR``."""
    neutrals = [entry.effect.parameters[name].neutral for name in trial]
    return neutrals == [1.0] and _size(entry, trial) > math.log(FAR) + 1e-9


def _side(entry: CatalogueEntry, trial: Mapping[str, float]) -> tuple[bool, ...]:
    """On which side of the neutral values a trial is."""
    return tuple(value > entry.effect.parameters[name].neutral for name, value in trial.items())


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
    if isinstance(entry.effect, NOT_LINEAR) or _is_far(entry, trial):
        return 0.0, 1.5
    parameter = entry.effect.parameters[entry.fitted[0]]
    if parameter.neutral == parameter.bounds[0]:
        return 0.0, MOST_SHARE
    least = lowest_value(entry.effect, simulation.model, beside)
    if not math.isfinite(least):
        return -MOST_SHARE, MOST_SHARE
    (value,) = trial.values()  # friction, damping, rotor and stiffness have one parameter, whose neutral value is zero
    ends = sorted((least / value, math.copysign(MOST_SHARE, value) if value < 0.0 else MOST_SHARE))
    return max(ends[0], -MOST_SHARE), min(ends[1], MOST_SHARE)
