"""Nonlinearities between command and actuation: dead band, saturation, backlash."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.effect import ActionEffect, Process
from torchrl_h2o.effects.parameter import ANY_AMOUNT, parameter
from torchrl_h2o.effects.selection import Indices, entry_mask


@dataclass(frozen=True)
class ActionDeadBand(ActionEffect):
    """A dead band: small commands have no effect, larger ones are reduced by the width of the band.

    Args:
        width: half the width of the band around zero, in units of the action.
        actuators: indices of the entries of the action that have a dead band; all by default.

    Examples:
        >>> import numpy as np
        >>> command = np.array([-1.0, 0.1, 0.5])
        >>> ActionDeadBand(0.2).process(0.05, np.random.default_rng(0))(command)
        array([-0.8,  0. ,  0.3])
    """

    wording: ClassVar[str] = "dead band of {width} on {actuators}"
    memoryless: ClassVar[bool] = True
    of_signal: ClassVar[str | None] = "width"
    width: float = parameter(unit="1", bounds=ANY_AMOUNT, neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def followed(action: np.ndarray) -> np.ndarray:
            beyond = np.sign(action) * np.maximum(np.abs(action) - self.width, 0.0)
            return np.where(entry_mask(action, self.actuators), beyond, action)

        return followed


@dataclass(frozen=True)
class ActionSaturation(ActionEffect):
    """Saturation: commands are clipped at a limit.

    Args:
        limit: largest magnitude of the executed action, in units of the action.
        actuators: indices of the entries of the action that saturate; all by default.

    Examples:
        >>> import numpy as np
        >>> ActionSaturation(0.6).process(0.05, np.random.default_rng(0))(np.array([-1.0, 0.1]))
        array([-0.6,  0.1])
        >>> ActionSaturation().is_neutral
        True
    """

    wording: ClassVar[str] = "saturation at {limit} of {actuators}"
    memoryless: ClassVar[bool] = True
    of_signal: ClassVar[str | None] = "limit"
    limit: float = parameter(unit="1", bounds=(0.0, math.inf), neutral=math.inf)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def cut(action: np.ndarray) -> np.ndarray:
            within = np.clip(action, -self.limit, self.limit)
            return np.where(entry_mask(action, self.actuators), within, action)

        return cut


@dataclass(frozen=True)
class ActionBacklash(ActionEffect):
    """Backlash between command and actuator, as in worn gears: after a reversal the actuator stays still at first.

    The executed action starts at zero. It follows the command at a distance of half a width, and stays constant while
    the command is nearer than that (play operator).

    Args:
        width: full width of the backlash, in units of the action.
        actuators: indices of the entries of the action that have backlash; all by default.

    Examples:
        >>> import numpy as np
        >>> loose = ActionBacklash(0.5).process(dt=0.05, rng=np.random.default_rng(0))
        >>> [float(loose(np.array([command]))[0]) for command in (0.25, 1.0, 0.5, 0.0)]
        [0.0, 0.75, 0.75, 0.25]
    """

    wording: ClassVar[str] = "backlash of {width} on {actuators}"
    of_signal: ClassVar[str | None] = "width"
    width: float = parameter(unit="1", bounds=ANY_AMOUNT, neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        half, last = 0.5 * self.width, np.zeros(())

        def pushed(action: np.ndarray) -> np.ndarray:
            nonlocal last
            last = np.minimum(np.maximum(last, action - half), action + half)
            return np.where(entry_mask(action, self.actuators), last, action)

        return pushed

    def run(self, actions: np.ndarray, dt: float, rng: np.random.Generator) -> np.ndarray:
        # each step clips the previous result to [low, high], and clips of 1, 2, 4, ... steps are again clips
        low, high = actions - 0.5 * self.width, actions + 0.5 * self.width
        steps = 1
        while steps < len(actions):
            later = low[steps:], high[steps:]
            low[steps:], high[steps:] = np.clip(low[:-steps], *later), np.clip(high[:-steps], *later)
            steps *= 2
        return np.where(entry_mask(actions, self.actuators), np.clip(0.0, low, high), actions)
