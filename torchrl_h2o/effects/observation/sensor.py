"""Sensor effects: noise, bias, gain and delay of the observation."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.delay_line import advanced, delay_line
from torchrl_h2o.effects.effect import ObservationEffect, Process
from torchrl_h2o.effects.parameter import ANY_AMOUNT, ANY_SIZE, parameter
from torchrl_h2o.effects.selection import Indices, entry_mask


@dataclass(frozen=True)
class ObservationNoise(ObservationEffect):
    """Gaussian noise on the observation, drawn independently at every reading.

    Args:
        std: standard deviation, in units of the observation.
        entries: indices of the noisy entries of the observation; all by default.

    Examples:
        >>> import numpy as np
        >>> noisy = ObservationNoise(0.1).process(dt=0.05, rng=np.random.default_rng(0))
        >>> noisy(np.zeros(2)).round(3)
        array([ 0.013, -0.013])
    """

    wording: ClassVar[str] = "noise of standard deviation {std} on {entries} of the observation"
    memoryless: ClassVar[bool] = True
    random: ClassVar[bool] = True
    of_signal: ClassVar[str | None] = "std"
    std: float = parameter(unit="1", bounds=ANY_AMOUNT, neutral=0.0)
    entries: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def noisy(observation: np.ndarray) -> np.ndarray:
            noise = self.std * rng.standard_normal(observation.shape)
            return observation + entry_mask(observation, self.entries) * noise

        return noisy


@dataclass(frozen=True)
class ObservationBias(ObservationEffect):
    """A constant offset of the observation.

    Args:
        bias: offset, in units of the observation.
        entries: indices of the offset entries of the observation; all by default.

    Examples:
        >>> import numpy as np
        >>> ObservationBias(0.5, entries=(1,)).process(0.05, np.random.default_rng(0))(np.zeros(2))
        array([0. , 0.5])
    """

    wording: ClassVar[str] = "bias of {bias} on {entries} of the observation"
    memoryless: ClassVar[bool] = True
    of_signal: ClassVar[str | None] = "bias"
    bias: float = parameter(unit="1", bounds=ANY_SIZE, neutral=0.0)
    entries: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def biased(observation: np.ndarray) -> np.ndarray:
            return observation + entry_mask(observation, self.entries) * self.bias

        return biased

    def restore(self, observations: np.ndarray, dt: float) -> np.ndarray:
        return observations - entry_mask(observations, self.entries) * self.bias


@dataclass(frozen=True)
class ObservationGain(ObservationEffect):
    """A gain error of the sensors.

    Args:
        scale: factor on the observation.
        entries: indices of the scaled entries of the observation; all by default.

    Examples:
        >>> import numpy as np
        >>> ObservationGain(1.5, entries=(1,)).process(0.05, np.random.default_rng(0))(np.ones(2))
        array([1. , 1.5])
    """

    wording: ClassVar[str] = "{entries} of the observation × {scale}"
    memoryless: ClassVar[bool] = True
    scale: float = parameter(unit="1", bounds=(-100.0, 100.0), neutral=1.0)
    entries: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def scaled(observation: np.ndarray) -> np.ndarray:
            return np.where(entry_mask(observation, self.entries), self.scale * observation, observation)

        return scaled

    def restore(self, observations: np.ndarray, dt: float) -> np.ndarray:
        inverse = 1.0 / self.scale if self.scale else np.nan
        return np.where(entry_mask(observations, self.entries), inverse * observations, observations)


@dataclass(frozen=True)
class ObservationDelay(ObservationEffect):
    """A delay of the sensors; the time need not be a whole number of control steps.

    The observation is interpolated linearly between two readings. Until a delayed reading is available, the first one
    is reported.

    Args:
        delay: the delay, in s.
        entries: indices of the delayed entries of the observation; all by default.

    Examples:
        >>> import numpy as np
        >>> late = ObservationDelay(0.015).process(dt=0.01, rng=np.random.default_rng(0))
        >>> [float(late(np.array([reading]))[0]) for reading in (1.0, 2.0, 3.0, 4.0)]
        [1.0, 1.0, 1.5, 2.5]
    """

    wording: ClassVar[str] = "{entries} of the observation late by {delay}"
    delay: float = parameter(unit="s", bounds=(0.0, 1.0), neutral=0.0)
    entries: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        late = delay_line(self.delay / dt, before=np.array)
        return lambda reading: np.where(entry_mask(reading, self.entries), late(reading), reading)

    def restore(self, observations: np.ndarray, dt: float) -> np.ndarray:
        ahead = advanced(observations, self.delay / dt)
        return np.where(entry_mask(observations, self.entries), ahead, observations)
