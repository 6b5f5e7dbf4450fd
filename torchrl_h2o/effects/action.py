"""Effects on the size of actions: stronger or weaker, off by a constant, noisy."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.effect import ActionEffect, Process
from torchrl_h2o.effects.entries import Indices, entry_mask
from torchrl_h2o.effects.parameter import parameter


@dataclass(frozen=True)
class ActionNoise(ActionEffect):
    """Gaussian noise on the executed action, drawn anew every control step.

    The noisy action may leave the bounds of the action; MuJoCo clamps the controls that are
    limited.

    Args:
        std: standard deviation, in units of the action.
        actuators: indices of the noisy entries of the action, all by default.

    Examples:
        >>> import numpy as np
        >>> noisy = ActionNoise(1.0).process(dt=0.05, rng=np.random.default_rng(0))
        >>> noisy(np.zeros(2)).round(3)
        array([ 0.126, -0.132])

    Source: H2O+ (arXiv 2309.12716), the gap ``joint_noise``.
    """

    wording: ClassVar[str] = "noise of standard deviation {std} on {actuators}"
    random: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True
    std: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def noisy(action: np.ndarray) -> np.ndarray:
            noise = self.std * rng.standard_normal(action.shape)
            return action + entry_mask(action, self.actuators) * noise

        return noisy


@dataclass(frozen=True)
class ActionGain(ActionEffect):
    """Actuation that is stronger or weaker than asked for.

    The scaled action may leave the bounds of the action; MuJoCo clamps the controls that are
    limited.

    Args:
        scale: factor on the action.
        actuators: indices of the scaled entries of the action, all by default.

    Examples:
        >>> import numpy as np
        >>> ActionGain(0.5, actuators=(1,)).process(0.05, np.random.default_rng(0))(np.ones(2))
        array([1. , 0.5])
    """

    wording: ClassVar[str] = "{actuators} × {scale}"
    memoryless: ClassVar[bool] = True
    scale: float = parameter(unit="1", bounds=(-10.0, 10.0), neutral=1.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def scaled(action: np.ndarray) -> np.ndarray:
            return np.where(entry_mask(action, self.actuators), self.scale * action, action)

        return scaled


@dataclass(frozen=True)
class ActionBias(ActionEffect):
    """Actuation that is off by a constant.

    Args:
        bias: what is added to the action, in units of the action.
        actuators: indices of the entries of the action that are off, all by default.

    Examples:
        >>> import numpy as np
        >>> ActionBias(0.5, actuators=(1,)).process(0.05, np.random.default_rng(0))(np.ones(2))
        array([1. , 1.5])
    """

    wording: ClassVar[str] = "bias of {bias} on {actuators}"
    memoryless: ClassVar[bool] = True
    bias: float = parameter(unit="1", bounds=(-100.0, 100.0), neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def biased(action: np.ndarray) -> np.ndarray:
            return action + entry_mask(action, self.actuators) * self.bias

        return biased
