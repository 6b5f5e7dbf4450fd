"""A hand-tuned balancing controller for the wheel-legged robot, used to record data in place of a human operator.

It keeps the robot upright, but position and velocity vary as in the real robot's log.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import OrnsteinUhlenbeckProcessModule

from torchrl_h2o.envs.wheel_legged.env import OBSERVATIONS, TARGET_VELOCITY

#: default gains in N·m per rad, rad/s, m and m/s; :class:`BalanceController` explains their choice
DEFAULT_GAINS = {
    "standing_still": {"theta": 9.0, "theta_dot": 0.9, "x": 0.4, "v": 1.3},
    "moving_forward": {"v": 1.3, "theta": 9.0, "theta_dot": 0.9},
}
# properties of the authors' robot, not thresholds
MAX_TORQUE = 3.0  # N·m, per motor
CONTROL_PERIOD = 0.005  # s


class StateFeedback(nn.Module):
    """``torque = gains · (observation - target)``, clipped to the bounds of the action.

    Args:
        gains: gains in N·m per unit of each observed quantity, (n,).
        target: target in units of the observation, (n,).
        max_torque: bound of the torque, in N·m.
    """

    gains: torch.Tensor
    target: torch.Tensor

    def __init__(self, gains: torch.Tensor, target: torch.Tensor, max_torque: float) -> None:
        super().__init__()
        self.register_buffer("gains", gains)
        self.register_buffer("target", target)
        self.max_torque = max_torque

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        torque = ((observation - self.target) * self.gains).sum(-1, keepdim=True)
        return torque.clamp(-self.max_torque, self.max_torque)


class BalanceController(TensorDictModule):
    """Balances the wheel-legged robot by state feedback; reads observation, writes action.

    All gains are positive, because a forward torque both moves the wheels under a body that leans forward and makes a
    moving robot lean back before it slows down. The default gains are below those of a linear-quadratic regulator in
    the angle and close to them in the velocity. With the default noise of :func:`noisy_balance_controller` pitch, pitch
    rate and velocity vary about as much as in the real log.

    Args:
        task: ``"standing_still"``, about x = 0, or ``"moving_forward"``, at 0.2 m/s.
        gains: gains in N·m per rad, rad/s, m and m/s, by the names of
            :data:`~torchrl_h2o.envs.wheel_legged.OBSERVATIONS`; missing ones keep their default.
        max_torque: bound of the torque, in N·m.

    Raises:
        ValueError: for an unknown task, or a gain for a quantity that the task does not observe.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> controller = BalanceController(gains={"theta": 10.0})
        >>> leaning = TensorDict({"observation": torch.tensor([0.1, 0.0, 0.0, 0.0])})
        >>> controller(leaning)["action"]
        tensor([1.])
    """

    def __init__(
        self,
        task: str = "standing_still",
        gains: Mapping[str, float] | None = None,
        max_torque: float = MAX_TORQUE,
    ) -> None:
        if task not in OBSERVATIONS:
            raise ValueError(f"no balance controller for the task {task!r}; choose one of {', '.join(OBSERVATIONS)}")
        names = OBSERVATIONS[task]
        if unknown := sorted(set(gains or {}) - set(names)):
            raise ValueError(f"gains has {', '.join(unknown)}, but {task} observes only {', '.join(names)}")
        merged = DEFAULT_GAINS[task] | dict(gains or {})
        target = {"v": TARGET_VELOCITY if task == "moving_forward" else 0.0}
        super().__init__(
            StateFeedback(
                torch.tensor([float(merged[name]) for name in names]),
                torch.tensor([target.get(name, 0.0) for name in names]),
                max_torque,
            ),
            in_keys=["observation"],
            out_keys=["action"],
        )


def noisy_balance_controller(
    task: str = "standing_still",
    gains: Mapping[str, float] | None = None,
    *,
    noise_std: float = 0.5,
    noise_time: float = 0.06,
    max_torque: float = MAX_TORQUE,
) -> TensorDictSequential:
    """:class:`BalanceController` with correlated noise on the torque, like that of a human operator.

    The noise is TorchRL's Ornstein-Uhlenbeck process: it is added only under
    ``set_exploration_type(ExplorationType.RANDOM)`` and restarts where ``is_init`` marks a new episode
    (:class:`torchrl.envs.InitTracker`). :func:`~torchrl_h2o.envs.record` provides both.

    Args:
        task: see :class:`BalanceController`.
        gains: see :class:`BalanceController`.
        noise_std: stationary standard deviation of the noise, in N·m.
        noise_time: time in which the autocorrelation falls to 1/e, in s; at least a control step.
        max_torque: bound of the torque including noise, in N·m.

    Returns:
        A policy that reads ``observation`` and ``is_init`` and writes ``action``.

    Raises:
        ValueError: for a negative ``noise_std``, or a ``noise_time`` shorter than a control step.

    Example:
        >>> from torchrl_h2o.envs.recording import record
        >>> from torchrl_h2o.envs.wheel_legged.env import WheelLeggedEnv
        >>> record(WheelLeggedEnv(), noisy_balance_controller(), 100, seed=0).shape
        torch.Size([100])
    """
    if noise_std < 0.0:
        raise ValueError(f"noise_std is {noise_std} N·m; it must not be negative")
    if noise_time < CONTROL_PERIOD:
        raise ValueError(f"noise_time is {noise_time} s; it must be at least the control period, {CONTROL_PERIOD} s")
    # TorchRL's process is n' = (1 - theta dt) n + sigma sqrt(dt) w, with the stationary variance
    # sigma^2 dt / (1 - (1 - theta dt)^2)
    decay = 1.0 - CONTROL_PERIOD / noise_time
    noise = OrnsteinUhlenbeckProcessModule(
        spec=Bounded(-max_torque, max_torque, torch.Size((1,))),
        theta=1.0 / noise_time,
        sigma=noise_std * math.sqrt((1.0 - decay**2) / CONTROL_PERIOD),
        dt=CONTROL_PERIOD,
    )
    # Any, because TensorDictSequential is annotated to take lists
    modules: list[Any] = [BalanceController(task, gains, max_torque), noise]
    return TensorDictSequential(*modules)
