"""A case of the benchmark: simulator, measured data, true effects and pass criterion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from systems import SYSTEMS, with_torque_noise
from tensordict import TensorDict

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals import Report, Simulation

TRANSITIONS = 5000


@dataclass(frozen=True, kw_only=True)
class Case:
    """One case. The code under test receives only the simulation and the data.

    Args:
        name: name of the case within its family.
        system: a name of :data:`~systems.SYSTEMS`.
        judge: maps a report and the case to scores by name; ``ok`` is whether the case passed.
        truth: the effects that correct the simulator.
        in_simulator: effects of the simulator.
        in_reality: effects of the measured system.
        noise: standard deviation of the sensor noise, as a fraction of each signal's standard deviation.
        torque_noise: standard deviation of the noise of the logged actions, as a fraction of each action's own; the
            system does not feel it.
        seed: random seed of the recording.
        transitions: number of recorded transitions.
        episode: steps until a reset.
        held_out: fraction of the data on which errors are reported, or the indices of these logs.
    """

    name: str
    system: str
    judge: Callable[[Report, Case], dict]
    truth: tuple[Effect, ...] = ()
    in_simulator: tuple[Effect, ...] = ()
    in_reality: tuple[Effect, ...] = ()
    noise: float = 0.0
    torque_noise: float = 0.0
    seed: int = 0
    transitions: int = TRANSITIONS
    episode: int = 500
    held_out: float | tuple[int, ...] = 0.25

    def simulation(self) -> Simulation:
        """Build the imperfect simulator."""
        return Simulation.from_env(SYSTEMS[self.system].env(self.in_simulator))

    def measure(self) -> TensorDict:
        """Record the data, TED ``(transitions,)``."""
        system = SYSTEMS[self.system]
        data = system.record(self.in_reality, self.transitions, self.seed, noise=self.noise, episode=self.episode)
        return with_torque_noise(data, self.torque_noise, self.seed) if self.torque_noise else data

    @property
    def words(self) -> str:
        """The true effects in words."""
        return ", ".join(effect.describe() for effect in self.truth) or "nothing"


@dataclass(frozen=True)
class Family:
    """One line of the benchmark's table.

    Args:
        draw: makes a case from its number and its own random generator.
        size: number of cases.
        asked: number of cases that should pass.
        what: pass criterion, in words.
        stream: number of its random stream, different for each family that draws at random.
    """

    draw: Callable[[int, np.random.Generator], Case]
    size: int
    asked: int
    what: str
    stream: int = 0


def draw_case(families: Mapping[str, Family], family: str, number: int, seed: int) -> Case:
    """Draw a case by family and number; the result depends only on these and the seed."""
    stream = np.random.SeedSequence((seed, families[family].stream, number))
    return families[family].draw(number, np.random.default_rng(stream))
