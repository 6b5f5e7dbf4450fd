"""User-defined effects for the tests."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from torchrl_h2o.effects import ActionEffect, ForceEffect, parameter


@dataclass(frozen=True)
class ControlForce(ForceEffect):
    """A force on the first degree of freedom, proportional to the first control."""

    wording: ClassVar[str] = "{gain} per control"
    gain: float = parameter(unit="N", bounds=(-1e6, 1e6), neutral=0.0)

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Callable:
        def force(data: mujoco.MjData) -> np.ndarray:
            return self.gain * data.ctrl[0] * np.eye(model.nv)[0]

        return force


@dataclass(frozen=True)
class Gust(ForceEffect):
    """A force that is constant within an episode and random between episodes; counts its physics steps."""

    wording: ClassVar[str] = "gusts of {strength}"
    random: ClassVar[bool] = True
    strength: float = parameter(unit="N", bounds=(0.0, 1e3), neutral=0.0)
    seen: tuple = ()  # lists, to which each episode appends (force, number of calls)

    def process(self, model: mujoco.MjModel, rng: np.random.Generator) -> Callable:
        gust = self.strength * rng.standard_normal() * np.eye(model.nv)[0]
        calls = []

        def force(data: mujoco.MjData) -> np.ndarray:
            calls.append(data.time)
            for log in self.seen:
                log.append((gust[0], len(calls)))
            return gust

        return force


@dataclass(frozen=True)
class ForgetfulNoise(ActionEffect):
    """Noise whose class is not marked random."""

    wording: ClassVar[str] = "forgetful noise of {std}"
    std: float = parameter(unit="1", bounds=(0.0, 1.0), neutral=0.0)

    def process(self, dt: float, rng: np.random.Generator) -> Callable:
        return lambda action: action + self.std * rng.standard_normal(action.shape)
