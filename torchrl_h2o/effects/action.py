"""Effects on the way in: what becomes of an action before the simulator executes it."""

from collections import deque
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.effect import ActionEffect, Process, parameter
from torchrl_h2o.effects.entries import Indices, entry_mask


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
    std: float = parameter(unit="1", bounds=(0.0, 10.0), neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def noisy(action: np.ndarray) -> np.ndarray:
            noise = self.std * rng.standard_normal(action.shape)
            return action + entry_mask(action, self.actuators) * noise

        return noisy


@dataclass(frozen=True)
class ActionDelay(ActionEffect):
    """Actuation that is late, by any time, also a fraction of a control step.

    With a delay of k + f control steps the drive still follows the command before last for the
    first f of a step. A control step executes one action, so it is given the mean of the two,
    (1 - f) · a(t - k) + f · a(t - k - 1), which has the same impulse. Before the first command the
    delay line holds zeros.

    Args:
        delay: the delay, in s.

    Examples:
        >>> import numpy as np
        >>> late = ActionDelay(0.015).process(dt=0.01, rng=np.random.default_rng(0))
        >>> [float(late(np.array([command]))[0]) for command in (1.0, 1.0, 1.0, 1.0)]
        [0.0, 0.5, 1.0, 1.0]
    """

    wording: ClassVar[str] = "actions late by {delay}"
    delay: float = parameter(unit="s", bounds=(0.0, 1.0), neutral=0.0)

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        steps, fraction = divmod(self.delay / dt, 1.0)
        line = deque(maxlen=int(steps) + 2)

        def late(action: np.ndarray) -> np.ndarray:
            if not line:
                line.extend([np.zeros_like(action)] * (line.maxlen - 1))
            line.append(action.copy())
            return (1.0 - fraction) * line[1] + fraction * line[0]

        return late


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
    scale: float = parameter(unit="1", bounds=(-10.0, 10.0), neutral=1.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def scaled(action: np.ndarray) -> np.ndarray:
            return np.where(entry_mask(action, self.actuators), self.scale * action, action)

        return scaled
