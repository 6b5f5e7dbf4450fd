"""A case of the benchmark: what is simulated, what was measured, what is true, and what it takes to pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from systems import SYSTEMS
from tensordict import TensorDict

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals import Report, Simulation

TRANSITIONS = 5000


@dataclass(frozen=True, kw_only=True)
class Case:
    """One case. The code under test is given the simulation and the data, and nothing else.

    Args:
        name: of the case within its family.
        system: a name of :data:`~systems.SYSTEMS`.
        judge: from a report and the case to what was reached, by name; ``ok`` is whether it passed.
        truth: the effects that mend the simulator.
        in_simulator: effects of the simulator.
        in_reality: effects of what is measured.
        noise: of the sensors, as a share of each signal's standard deviation.
        seed: of the recording.
        transitions: how many are recorded.
        episode: steps after which the system starts anew.
        held_out: share of the data that no fit sees.
    """

    name: str
    system: str
    judge: Callable[[Report, Case], dict]
    truth: tuple[Effect, ...] = ()
    in_simulator: tuple[Effect, ...] = ()
    in_reality: tuple[Effect, ...] = ()
    noise: float = 0.0
    seed: int = 0
    transitions: int = TRANSITIONS
    episode: int = 500
    held_out: float = 0.3

    def simulation(self) -> Simulation:
        """The imperfect simulator."""
        return Simulation.from_env(SYSTEMS[self.system].env(self.in_simulator))

    def measure(self) -> TensorDict:
        """The data, TED ``(transitions,)``."""
        system = SYSTEMS[self.system]
        return system.record(self.in_reality, self.transitions, self.seed, noise=self.noise, episode=self.episode)

    @property
    def truth_in_words(self) -> str:
        return ", ".join(effect.describe() for effect in self.truth) or "nothing"


@dataclass(frozen=True)
class Family:
    """A line of the benchmark's table.

    Args:
        draw: makes the case of a number, of a random generator that is that case's own.
        size: how many cases it has.
        asked: how many of them are to pass.
        what: what is asked of each, in words.
    """

    draw: Callable[[int, np.random.Generator], Case]
    size: int
    asked: int
    what: str


def draw_case(families: Mapping[str, Family], family: str, number: int, seed: int) -> Case:
    """The case of a family and a number; the same seed draws the same truth, whatever else is drawn."""
    stream = np.random.SeedSequence((seed, sorted(families).index(family), number))
    return families[family].draw(number, np.random.default_rng(stream))
