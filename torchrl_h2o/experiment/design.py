"""Searches the commands under which explanations differ most, within the limits of the machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_h2o.experiment.excitation import FAMILIES, candidate, spline
from torchrl_h2o.experiment.limits import Limits, executed_from_rest
from torchrl_h2o.experiment.separation import (
    Explained,
    Further,
    Motion,
    Yardstick,
    information_of,
    nats_apart,
    overlaps,
    predicted,
    slopes_along,
)
from torchrl_h2o.likelihood import ENOUGH
from torchrl_h2o.residuals.simulation.simulation import Simulation

SCALES = np.geomspace(1.0, 0.03, 9)  # tried shares of the largest commands
SUFFICES = 4.0 * ENOUGH  # nats beyond which a pair of explanations counts as told apart
FOR_CANDIDATES = 0.5  # share of the time for random candidates; the rest improves the best of them
KEPT = 4  # candidates that are improved in turn
UNKNOWN = 0.5  # weight of effects that are in no explanation
MOVE = 0.3  # standard deviation of a change of a knot, in the largest command


@dataclass(frozen=True, eq=False)
class Setting:
    """What an experiment is designed for.

    Args:
        explanations: those that the log leaves open, the likeliest first.
        yard: the usual errors of predictions.
        limits: limits of the machine.
        rest: state at rest, (nq + nv).
        command: command at rest, (nu).
        steps: control steps of the experiment.
        band: highest frequency of the commands, in Hz.
        noise: standard deviation of the noise of the readings, (n), in their units.
        unknown: effects of the catalogue beside the first explanation, which may be there.
        guards: further simulators that must keep the limits, because none of the explanations may be the truth.
    """

    explanations: Sequence[Explained]
    yard: Yardstick
    limits: Limits
    rest: np.ndarray
    command: np.ndarray
    steps: int
    band: float
    noise: np.ndarray
    guards: Sequence[Simulation] = ()
    unknown: Sequence[Further] = ()

    @property
    def base(self) -> Simulation:
        """The simulator without effects."""
        return self.explanations[0].base

    @property
    def seconds(self) -> float:
        """Duration, in s."""
        return self.steps * self.base.control_step

    def commands(self, knots: np.ndarray) -> np.ndarray:
        """Commands, (T, nu), of knots (k, nu) between -1 and 1: about the command at rest, up to the limits."""
        low, high = self.limits.command.T
        shape = spline(knots, self.seconds, self.steps)
        return self.command + np.where(shape > 0.0, shape * (high - self.command), shape * (self.command - low))

    def largest(self, knots: np.ndarray) -> np.ndarray | None:
        """The knots at the largest scale at which all keep the limits; None if there is none."""
        good, tried = np.ones(len(SCALES), bool), [self.commands(scale * knots) for scale in SCALES]
        starts = np.broadcast_to(self.rest, (len(tried), len(self.rest)))
        for simulation in (*self.guards, *(one.simulation for one in self.explanations)):
            executed = np.stack([executed_from_rest(simulation, actions) for actions in tried])
            good &= self.limits.kept(simulation.rollout(starts, executed))
        return SCALES[good.argmax()] * knots if good.any() else None

    def motion(self, index: int, knots: np.ndarray) -> Motion:
        """The motion that an explanation predicts."""
        return Motion.of(self.explanations[index].simulation, self.rest, self.commands(knots))

    def touches(self, knots: np.ndarray) -> bool:
        """Whether parts touch in a simulator that must keep the limits."""
        commands = self.commands(knots)
        simulators = (*self.guards, *(one.simulation for one in self.explanations))
        return any(self.limits.touches(one, Motion.of(one, self.rest, commands).states) for one in simulators)

    def nats(self, knots: np.ndarray) -> dict[tuple[int, int], float]:
        """Expected log likelihood ratio of each explanation against each other, if the first one is the truth."""
        found = {}
        for i, truth in enumerate(self.explanations):
            motion = self.motion(i, knots)
            seen = predicted(truth.simulation, motion, self.yard)
            for j, rival in enumerate(self.explanations):
                if j != i:
                    found[i, j] = nats_apart(motion, rival, seen, self.yard)
        return found

    def value(self, knots: np.ndarray) -> float:
        """What an experiment is worth: the separation of all pairs, or the volume by which intervals shrink.

        None of the explanations may be the truth. So it also counts, with a smaller weight, how far effects of the
        catalogue that are not in the first one would show.
        """
        if len(self.explanations) > 1:
            own = float(np.minimum(list(self.nats(knots).values()), SUFFICES).mean())
        else:
            own = self.narrowing(knots)
        if not self.unknown:
            return own
        return own + UNKNOWN * float(np.minimum(self.overlaps(knots).diagonal(), SUFFICES).mean())

    def overlaps(self, knots: np.ndarray) -> np.ndarray:
        """How far each of the unknown effects would show, and how alike they would, (E, E); see :func:`overlaps`."""
        first, motion = self.explanations[0], self.motion(0, knots)
        slopes = slopes_along(first, motion, self.yard, predicted(first.simulation, motion, self.yard))
        return overlaps(first, motion, self.yard, [one.simulation for one in self.unknown], slopes)

    def narrowing(self, knots: np.ndarray) -> float:
        """Half the log of the ratio of the determinants of what both logs and the first one tell of the values."""
        (one, *_) = self.explanations
        more = information_of(one, self.motion(0, knots), self.yard)
        (_, after), (_, before) = np.linalg.slogdet(one.information + more), np.linalg.slogdet(one.information)
        return 0.5 * float(after - before)


def best_commands(
    setting: Setting,
    rng: np.random.Generator,
    budget: float,
    *,
    value: Callable[[np.ndarray], float] | None = None,
    show: Callable[[float], object] = lambda share: None,
) -> np.ndarray:
    """Knots of the best commands found, (k, nu).

    Args:
        setting: what they are for.
        rng: draws candidates.
        budget: time to search, in s of the process's CPU.
        value: what knots are worth; by default :meth:`Setting.value`.
        show: called with the share of the budget that has passed.

    Raises:
        ValueError: if no candidate keeps the limits.
    """
    worth = value or setting.value
    begin, found, tried = time.process_time(), [], 0

    def passed() -> float:
        return (time.process_time() - begin) / budget

    while passed() < FOR_CANDIDATES or not found:
        family = list(FAMILIES)[tried % len(FAMILIES)]
        drawn = setting.largest(candidate(family, setting.seconds, len(setting.command), setting.band, rng))
        tried += 1
        if drawn is not None and not setting.touches(drawn):
            found.append((worth(drawn), drawn))
            found.sort(key=lambda one: -one[0])
            del found[KEPT:]
        if not found and passed() > 1.0:
            raise ValueError(
                "no commands keep the limits: allow a larger distance with within=, or more speed with speed="
            )
        show(passed())
    place = 0
    while passed() < 1.0:
        best, knots = found[place % len(found)]
        change = np.zeros_like(knots)
        some = rng.random(len(knots)) < 0.2
        some[0] = some[np.flatnonzero(np.abs(knots).sum(1) > 0.0).max(initial=0) + 1 :] = False
        change[some] = MOVE * rng.standard_normal((some.sum(), knots.shape[1]))
        other = setting.largest(np.clip(knots * rng.uniform(0.9, 1.2) + change, -1.0, 1.0))
        if other is not None and not setting.touches(other) and (own := worth(other)) > best:
            found[place % len(found)] = own, other
        place += 1
        show(passed())
    return max(found, key=lambda one: one[0])[1]
