"""How far an experiment tells explanations of the same log apart, in nats, and how far it narrows their values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect
from torchrl_h2o.experiment.limits import executed_from_rest
from torchrl_h2o.residuals.ground import Found, Ground
from torchrl_h2o.residuals.refit import Variable, slopes_of, variables_of, with_values
from torchrl_h2o.residuals.score import fitted_scales
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.whitened import whitened

AHEAD = 0.3  # s over which predictions look ahead where no log tells how far they can
STEP = 0.02  # move of a value, in its typical size, by which derivatives are computed


@dataclass(frozen=True, eq=False)
class Yardstick:
    """How far errors of predictions usually are from zero, in the data at hand.

    Args:
        steps: control steps of a block, over which predictions look ahead.
        std: standard deviation of the errors 1, 2, 4, ... steps ahead, (h, n), in units of the readings.
        seen: indices of the readings, (n).
    """

    steps: int
    std: np.ndarray
    seen: np.ndarray

    @classmethod
    def of_encoders(cls, simulation: Simulation, noise: float) -> Yardstick:
        """That of readings of positions with a standard deviation of their noise, in rad or m, over ``AHEAD``."""
        count = max(1, round(math.log2(AHEAD / simulation.control_step)))
        positions = simulation.state_map.observe[:, : simulation.model.nq]
        seen = np.flatnonzero((positions != 0.0).any(axis=1))
        return cls(2**count, np.full((count + 1, len(seen)), noise), seen)

    @classmethod
    def of(cls, ground: Ground) -> Yardstick:
        """That of the errors of the set near which sets are compared."""
        part = ground.base.fit
        scales = fitted_scales(part, part.errors())
        variances = [np.median(v, axis=0) + s for v, s in zip(part.variances, scales, strict=True)]
        record = part.record
        spread = record.spread[: record.num_readings]
        return cls(part.blocks.steps, np.sqrt(np.concatenate(variances)) * spread, record.seen)

    @property
    def horizons(self) -> np.ndarray:
        """Control steps ahead at which predictions are compared, (h)."""
        return 2 ** np.arange(len(self.std))


@dataclass(frozen=True, eq=False)
class Explained:
    """An explanation of the log, as a simulator whose values are known from it.

    Args:
        base: the simulator without effects.
        found: the effects at their fitted values, with their scores in the log.
        variables: the fitted values.
        information: what the log tells of them, (p, p): the curvature of its log density.
    """

    base: Simulation
    found: Found
    variables: Sequence[Variable]
    information: np.ndarray

    @classmethod
    def of(cls, ground: Ground, found: Found) -> Explained:
        """The explanation with a set of effects that was fitted to the log."""
        part = ground.fit_part(found.effects)
        errors = part.errors(found.effects)
        variables = variables_of(part, found.entries, found.effects)
        (slopes,) = slopes_of([part], found.effects, variables, [errors])
        _, inverse, share = whitened(part, errors, fitted_scales(part, errors))
        scaled = slopes * inverse[:, None]
        information = scaled.T @ (share[:, None] * scaled)
        return cls(ground.simulation, found, variables, information + 1e-9 * np.eye(len(variables)))

    @classmethod
    def nothing(cls, base: Simulation) -> Explained:
        """The explanation that the simulator lacks nothing."""
        return cls(base, Found((), (), np.zeros(0)), (), np.zeros((0, 0)))

    def at(self, moves: np.ndarray) -> tuple[Effect, ...]:
        """The effects with their values moved."""
        return with_values(self.found.effects, self.variables, moves)

    @cached_property
    def simulation(self) -> Simulation:
        """The simulator with the effects."""
        return self.base.with_effects(*self.found.effects)

    @cached_property
    def moved(self) -> tuple[Simulation, ...]:
        """The simulator with each value moved by ``STEP``."""
        units = STEP * np.eye(len(self.variables))
        return tuple(self.base.with_effects(*self.at(unit)) for unit in units)


@dataclass(frozen=True, eq=False)
class Further:
    """An effect of the catalogue beside those of an explanation, which may be there.

    Args:
        entry: the catalogue entry.
        effect: the effect, at a usual size or a smaller one.
        beside: the simulator with the explanation.
    """

    entry: CatalogueEntry
    effect: Effect
    beside: Simulation

    @cached_property
    def simulation(self) -> Simulation:
        """The simulator with the explanation and the effect."""
        return self.beside.with_effects(self.effect)

    def resized(self, share: float) -> Further:
        """The effect with fitted values nearer to neutral; values without a finite neutral one stay."""
        neutral, present = self.entry.effect.parameters, self.effect.parameters
        values = {
            name: neutral[name].value + share * (present[name].value - neutral[name].value)
            for name in self.entry.fitted
            if math.isfinite(neutral[name].value)
        }
        return Further(self.entry, self.effect.with_parameters(values), self.beside)


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion that an explanation predicts for an experiment.

    Args:
        states: before each action and after the last one, (T + 1, nq + nv).
        actions: the commands, (T, nu).
        readings: what its sensors read in these states, (T + 1, n).
    """

    states: np.ndarray
    actions: np.ndarray
    readings: np.ndarray

    @classmethod
    def of(cls, simulation: Simulation, rest: np.ndarray, actions: np.ndarray) -> Motion:
        """The motion from a state at rest."""
        path = simulation.rollout(rest[None], executed_from_rest(simulation, actions)[None])[0]
        states = np.concatenate([rest[None], path])
        return cls(states, actions, simulation.observed(states))


def predicted(simulation: Simulation, motion: Motion, yard: Yardstick) -> np.ndarray:
    """Readings that a simulator predicts along a motion, (B, h, n), in usual errors.

    It starts from the states that it infers from the readings. A zero of a sensor that is off is seen only where it
    changes what follows.
    """
    first = np.arange(0, len(motion.actions) - yard.steps + 1, yard.steps)
    executed, state_map = executed_from_rest(simulation, motion.actions), simulation.state_map
    states = motion.states[first]
    inferred = simulation.true_observations(motion.readings)[first] - state_map.observations(states)
    states = states + np.nan_to_num(inferred) @ state_map.restore_observed.T
    active = simulation.activations(executed) if simulation.model.na else None
    reached = simulation.rollout(
        states,
        executed[first[:, None] + np.arange(yard.steps)],
        time=first * simulation.control_step,
        activations=None if active is None else active[first],
    )
    seen = simulation.observed(reached[:, yard.horizons - 1])[..., yard.seen]
    return np.nan_to_num(seen / yard.std, nan=1e3, posinf=1e3, neginf=-1e3)


def slopes_along(explained: Explained, motion: Motion, yard: Yardstick, before: np.ndarray) -> np.ndarray:
    """Derivatives of the predictions by the values of an explanation, (N, p), of predictions ``before`` them."""
    columns = [(predicted(one, motion, yard) - before).ravel() / STEP for one in explained.moved]
    return np.stack(columns, axis=1) if columns else np.zeros((before.size, 0))


def nats_apart(truth: Motion, rival: Explained, seen: np.ndarray, yard: Yardstick) -> float:
    """Expected log likelihood ratio of the motion under the truth against a rival that is fitted to both logs.

    The rival's values move as far as the earlier log lets them.

    Args:
        truth: the motion that is measured.
        rival: the explanation.
        seen: readings that the truth predicts, (B, h, n); see :func:`predicted`.
        yard: the usual errors.
    """
    before = predicted(rival.simulation, truth, yard)
    share, error = 1.0 / len(yard.std), (before - seen).ravel()
    error = np.clip(error, -1e3, 1e3)
    total = float(share * error @ error)
    if rival.variables:
        slopes = slopes_along(rival, truth, yard, before)
        curvature, pull = share * slopes.T @ slopes + rival.information, share * slopes.T @ error
        total -= float(pull @ np.linalg.solve(curvature, pull))
    return 0.5 * max(total, 0.0)


def overlaps(
    explained: Explained, motion: Motion, yard: Yardstick, others: Sequence[Simulation], slopes: np.ndarray
) -> np.ndarray:
    """How far further effects change the predictions, and how alike, after the values were fitted, (E, E), in nats.

    An effect's own entry is the expected log likelihood ratio for it, if it is there. Two effects change the
    predictions alike if the entry of both is near the geometric mean of their own.

    Args:
        explained: the explanation beside which they would be.
        motion: its motion.
        yard: the usual errors.
        others: the simulators with one further effect each.
        slopes: derivatives of its predictions by its values; see :func:`slopes_along`.
    """
    seen, share = predicted(explained.simulation, motion, yard), 1.0 / len(yard.std)
    changes = np.stack([(predicted(one, motion, yard) - seen).ravel() for one in others]).clip(-1e3, 1e3)
    products = share * changes @ changes.T
    if explained.variables:
        pulls = share * changes @ slopes
        products -= pulls @ np.linalg.solve(share * slopes.T @ slopes + explained.information, pulls.T)
    return 0.5 * products


def information_of(explained: Explained, motion: Motion, yard: Yardstick) -> np.ndarray:
    """What a motion tells of the values of an explanation, (p, p)."""
    slopes = slopes_along(explained, motion, yard, predicted(explained.simulation, motion, yard))
    return slopes.T @ slopes / len(yard.std)
