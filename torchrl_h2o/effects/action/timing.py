"""Effects on the timing of actuators: delay, first-order lag and lead."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from torchrl_h2o.effects.delay_line import delay_line, delayed
from torchrl_h2o.effects.effect import ActionEffect, Process
from torchrl_h2o.effects.parameter import parameter
from torchrl_h2o.effects.selection import Indices, entry_mask


@dataclass(frozen=True)
class ActionDelay(ActionEffect):
    """A delay of the actuation; the time need not be a whole number of control steps.

    With a delay of k + f control steps, the drive follows a(t - k - 1) for the first fraction f of a step and a(t - k)
    for the rest. A control step executes one action, so it executes the mean, (1 - f) · a(t - k) + f · a(t - k - 1),
    which has the same impulse. Actions before the first command are taken as zero.

    Args:
        delay: the delay, in s.
        actuators: indices of the delayed entries of the action; all by default.

    Examples:
        >>> import numpy as np
        >>> late = ActionDelay(0.015).process(dt=0.01, rng=np.random.default_rng(0))
        >>> [float(late(np.array([command]))[0]) for command in (1.0, 1.0, 1.0, 1.0)]
        [0.0, 0.5, 1.0, 1.0]
    """

    wording: ClassVar[str] = "{actuators} late by {delay}"
    delay: float = parameter(unit="s", bounds=(0.0, 1.0), neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        late = delay_line(self.delay / dt, before=np.zeros_like)
        return lambda action: np.where(entry_mask(action, self.actuators), late(action), action)

    def run(self, actions: np.ndarray, dt: float, rng: np.random.Generator) -> np.ndarray:
        late = delayed(actions, self.delay / dt, before=np.zeros(actions.shape[1:]))
        return np.where(entry_mask(actions, self.actuators), late, actions)


@dataclass(frozen=True)
class ActionLag(ActionEffect):
    """A first-order lag of the actuation.

    The drive obeys ẏ = (a - y) / T and starts at y = 0. The command a is constant within a control step, so y is
    computed exactly; the step executes the mean of y, which has the same impulse.

    Args:
        time_constant: T, in s; the drive covers 63 % of a step of the command in this time.
        actuators: indices of the lagging entries of the action; all by default.

    Examples:
        >>> import numpy as np
        >>> lagging = ActionLag(0.01).process(dt=0.01, rng=np.random.default_rng(0))
        >>> [round(float(lagging(np.array([command]))[0]), 3) for command in (1.0, 1.0, 1.0, 0.0)]
        [0.368, 0.767, 0.914, 0.601]
    """

    wording: ClassVar[str] = "{actuators} follow with a time constant of {time_constant}"
    time_constant: float = parameter(unit="s", bounds=(0.0, 10.0), neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        left, mean_left = self._left_after(dt)
        drive = np.zeros(())

        def lagging(action: np.ndarray) -> np.ndarray:
            nonlocal drive
            behind = drive - action
            drive = action + left * behind
            return np.where(entry_mask(action, self.actuators), action + mean_left * behind, action)

        return lagging

    def run(self, actions: np.ndarray, dt: float, rng: np.random.Generator) -> np.ndarray:
        left, mean_left = self._left_after(dt)
        drive = (1.0 - left) * actions
        steps, weight = 1, left  # y(t) = Σ (1 - left) · leftⁱ · a(t - i), with 1, 2, 4, ... terms
        while steps < len(actions) and weight > 0.0:
            drive[steps:] = drive[steps:] + weight * drive[:-steps]
            steps, weight = 2 * steps, weight * weight
        behind = np.concatenate([np.zeros_like(drive[:1]), drive[:-1]]) - actions
        return np.where(entry_mask(actions, self.actuators), actions + mean_left * behind, actions)

    def _left_after(self, dt: float) -> tuple[float, float]:
        """Returns the shares of the initial error y - a that remain: at the end of a control step, and on average."""
        if self.time_constant == 0.0:
            return 0.0, 0.0
        ratio = dt / self.time_constant
        return math.exp(-ratio), -math.expm1(-ratio) / ratio


@dataclass(frozen=True)
class ActionLead(ActionEffect):
    r"""The derivative gain of servos acts on the target, too: the executed action leads the commanded one.

    A servo whose torque is :math:`K_p e + K_d \dot e`, with the error e between target and position, does what one with
    :math:`K_d` on the velocity alone does with the target :math:`u + T \dot u`, where :math:`T = K_d / K_p`. The
    derivative is that between two control steps.

    Args:
        time: T, the derivative time, in s.
        actuators: indices of the leading entries of the action; all by default.

    Examples:
        >>> import numpy as np
        >>> leading = ActionLead(0.005).process(dt=0.01, rng=np.random.default_rng(0))
        >>> [float(leading(np.array([command]))[0]) for command in (1.0, 1.0, 2.0, 2.0)]
        [1.0, 1.0, 2.5, 2.0]
    """

    wording: ClassVar[str] = "{actuators} lead by {time} (derivative gain on the target)"
    time: float = parameter(unit="s", bounds=(0.0, 1.0), neutral=0.0)
    actuators: Indices = None

    def process(self, dt: float, rng: np.random.Generator) -> Process:
        before: np.ndarray | None = None

        def leading(action: np.ndarray) -> np.ndarray:
            nonlocal before
            rise = 0.0 if before is None else action - before
            before = action
            return np.where(entry_mask(action, self.actuators), action + self.time / dt * rise, action)

        return leading

    def run(self, actions: np.ndarray, dt: float, rng: np.random.Generator) -> np.ndarray:
        leading = actions + self.time / dt * np.diff(actions, axis=0, prepend=actions[:1])
        return np.where(entry_mask(actions, self.actuators), leading, actions)
