"""Effects on the way out: what the sensors make of the simulator's state."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.effect import ObservationEffect, Process, parameter
from torchrl_h2o.effects.entries import Indices, entry_mask


@dataclass(frozen=True)
class ObservationNoise(ObservationEffect):
    """Gaussian noise on the observation, drawn anew at every reading.

    Args:
        std: standard deviation, in units of the observation.
        entries: indices of the noisy entries of the observation, all by default.

    Examples:
        >>> import numpy as np
        >>> noisy = ObservationNoise(0.1).process(dt=0.05, rng=np.random.default_rng(0))
        >>> noisy(np.zeros(2)).round(3)
        array([ 0.013, -0.013])
    """

    wording: ClassVar[str] = "noise of standard deviation {std} on {entries} of the observation"
    random: ClassVar[bool] = True
    std: float = parameter(unit="1", bounds=(0.0, 100.0), neutral=0.0)
    entries: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def noisy(observation: np.ndarray) -> np.ndarray:
            noise = self.std * rng.standard_normal(observation.shape)
            return observation + entry_mask(observation, self.entries) * noise

        return noisy


@dataclass(frozen=True)
class ObservationBias(ObservationEffect):
    """A constant error of the observation.

    Args:
        bias: what is added, in units of the observation.
        entries: indices of the wrong entries of the observation, all by default.

    Examples:
        >>> import numpy as np
        >>> ObservationBias(0.5, entries=(1,)).process(0.05, np.random.default_rng(0))(np.zeros(2))
        array([0. , 0.5])
    """

    wording: ClassVar[str] = "bias of {bias} on {entries} of the observation"
    bias: float = parameter(unit="1", bounds=(-100.0, 100.0), neutral=0.0)
    entries: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def biased(observation: np.ndarray) -> np.ndarray:
            return observation + entry_mask(observation, self.entries) * self.bias

        return biased
