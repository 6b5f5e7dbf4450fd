"""Effects on the size of actions: gain, bias and noise."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.effect import NO_NAMES, ActionEffect, EntryNames, Process
from torchrl_h2o.effects.parameter import ANY_SIZE, parameter
from torchrl_h2o.effects.selection import Indices, entry_mask


@dataclass(frozen=True)
class ActionNoise(ActionEffect):
    """Gaussian noise on the executed action, drawn independently at every control step.

    The noisy action may exceed the bounds of the action; MuJoCo clamps the controls that have limits.

    A negative ``std`` removes noise from a simulator that is noisier than reality. It cannot be executed by itself.
    Instead, :func:`balanced` reduces the noise of the effects before it. :class:`~torchrl_h2o.envs.DynamicsGap` calls
    this function for all gaps on an env.

    Args:
        std: standard deviation, in units of the action. A negative value removes noise that the effects before it
            add. Variances are added, so 1 followed by -0.6 leaves sqrt(1 - 0.36) = 0.8.
        actuators: indices of the noisy entries of the action; all by default.

    Examples:
        >>> import numpy as np
        >>> noisy = ActionNoise(1.0).process(dt=0.05, rng=np.random.default_rng(0))
        >>> noisy(np.zeros(2)).round(3)
        array([ 0.126, -0.132])
        >>> ActionNoise(-1.0).describe()
        'noise of standard deviation 1 taken off all actuators'

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, the gap ``joint_noise``.
    """

    wording: ClassVar[str] = "noise of standard deviation {std} on {actuators}"
    random: ClassVar[bool] = True
    memoryless: ClassVar[bool] = True
    of_signal: ClassVar[str | None] = "std"
    std: float = parameter(unit="1", bounds=ANY_SIZE, neutral=0.0)
    actuators: Indices = None

    def describe(self, names: EntryNames = NO_NAMES) -> str:
        if self.std >= 0.0:
            return super().describe(names)
        added = self.with_parameters({"std": -self.std})
        return added.describe(names).replace(" on ", " taken off ")

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        if self.std < 0.0:
            raise ValueError(
                f"ActionNoise: std = {self.std:g} cannot be executed by itself, because it removes noise that the "
                "effects before it add; pass all effects together through balanced(effects) first"
            )

        def noisy(action: np.ndarray) -> np.ndarray:
            noise = self.std * rng.standard_normal(action.shape)
            return action + entry_mask(action, self.actuators) * noise

        return noisy


@dataclass(frozen=True)
class ActionGain(ActionEffect):
    """A gain of the actuation: the executed action is stronger or weaker than the commanded one.

    The scaled action may exceed the bounds of the action; MuJoCo clamps the controls that have limits.

    Args:
        scale: factor on the action.
        actuators: indices of the scaled entries of the action; all by default.

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
    """A constant offset of the executed action.

    Args:
        bias: offset added to the action, in units of the action.
        actuators: indices of the offset entries of the action; all by default.

    Examples:
        >>> import numpy as np
        >>> ActionBias(0.5, actuators=(1,)).process(0.05, np.random.default_rng(0))(np.ones(2))
        array([1. , 1.5])
    """

    wording: ClassVar[str] = "bias of {bias} on {actuators}"
    memoryless: ClassVar[bool] = True
    of_signal: ClassVar[str | None] = "bias"
    bias: float = parameter(unit="1", bounds=ANY_SIZE, neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        def biased(action: np.ndarray) -> np.ndarray:
            return action + entry_mask(action, self.actuators) * self.bias

        return biased
