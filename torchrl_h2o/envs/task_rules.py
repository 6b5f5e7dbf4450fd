"""Observations, rewards and terminations of Gymnasium's MuJoCo tasks, for many worlds at once.

These are Gymnasium's formulas with the constants of the task object; the tests compare them with Gymnasium.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from gymnasium.envs.mujoco import half_cheetah_v4, hopper_v4, walker2d_v4
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

from torchrl_h2o.envs.wheel_legged.env import MAX_PITCH, WheelLeggedMujocoEnv, reward

if TYPE_CHECKING:
    from gymnasium.envs.mujoco import MujocoEnv


class TaskRules(ABC):
    """The observation, reward and termination of one task.

    Args:
        task: the Gymnasium task, whose constants are read.
    """

    def __init__(self, task: MujocoEnv) -> None:
        self.task = task

    @abstractmethod
    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Returns the observations (N, n) of states (N, nq), (N, nv) in a new array; the env reuses the states."""

    @abstractmethod
    def reward(
        self, before: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray, control_step: np.ndarray
    ) -> np.ndarray:
        """Returns the rewards (N,) of one step.

        Args:
            before: positions at the start of the step, (N, nq).
            qpos: positions at the end of the step, (N, nq).
            qvel: velocities at the end of the step, (N, nv).
            action: executed actions, (N, nu).
            control_step: the control step of each world in s, (N,).
        """

    @abstractmethod
    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Returns whether episodes end in these states, (N,)."""


class Running(TaskRules):
    """HalfCheetah: rewards forward velocity minus control cost; never terminates."""

    task: HalfCheetahEnv | HopperEnv | Walker2dEnv

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        skipped = int(self.task._exclude_current_positions_from_observation)
        return np.concatenate([qpos[:, skipped:], qvel], axis=1)

    def reward(
        self, before: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray, control_step: np.ndarray
    ) -> np.ndarray:
        forward = self.task._forward_reward_weight * ((qpos[:, 0] - before[:, 0]) / control_step)
        return forward + self._survival(qpos, qvel) - self.task._ctrl_cost_weight * np.sum(np.square(action), axis=1)

    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return np.zeros(len(qpos), dtype=bool)

    def _survival(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray | float:
        return 0.0


class Walking(Running):
    """Walker2d: as HalfCheetah, with clipped velocities, a healthy reward, and termination when unhealthy."""

    task: HopperEnv | Walker2dEnv

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return super().observe(qpos, np.clip(qvel, -10.0, 10.0))  # Gymnasium's own bounds

    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        if not self.task._terminate_when_unhealthy:
            return super().is_terminated(qpos, qvel)
        return ~self._is_healthy(qpos, qvel)

    def _survival(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray | float:
        if isinstance(self.task, _PAY_THE_LAST_STEP) and self.task._terminate_when_unhealthy:
            return self.task._healthy_reward
        return self._is_healthy(qpos, qvel) * self.task._healthy_reward

    def _is_healthy(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return _within(qpos[:, 1], self.task._healthy_z_range) & _within(qpos[:, 2], self.task._healthy_angle_range)


class Hopping(Walking):
    """Hopper: as Walker2d, and healthy only while all other coordinates are within a range."""

    task: HopperEnv

    def _is_healthy(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        rest = np.concatenate([qpos[:, 2:], qvel], axis=1)
        return super()._is_healthy(qpos, qvel) & _within(rest, self.task._healthy_state_range).all(1)


class Balancing(TaskRules):
    """The wheel-legged robot: the reward of its task; terminates when it falls."""

    task: WheelLeggedMujocoEnv

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        x, theta, v, theta_dot = qpos[:, 0], qpos[:, 2], qvel[:, 0], qvel[:, 2]
        seen = (theta, theta_dot, x, v) if self.task.task == "standing_still" else (v, theta, theta_dot)
        return np.stack(seen, axis=1).astype(np.float32)

    def reward(
        self, before: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray, control_step: np.ndarray
    ) -> np.ndarray:
        observation = self.observe(qpos, qvel)
        return reward(self.task.task, observation, action, observation)

    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return ~(np.abs(qpos[:, 2]) <= MAX_PITCH)  # this form also counts a NaN pitch as fallen


# version 4 also pays the healthy reward in the step that ends unhealthy
_PAY_THE_LAST_STEP = (hopper_v4.HopperEnv, walker2d_v4.Walker2dEnv)

RULES: dict[type[MujocoEnv], type[TaskRules]] = {
    HalfCheetahEnv: Running,
    HopperEnv: Hopping,
    Walker2dEnv: Walking,
    half_cheetah_v4.HalfCheetahEnv: Running,
    hopper_v4.HopperEnv: Hopping,
    walker2d_v4.Walker2dEnv: Walking,
    WheelLeggedMujocoEnv: Balancing,
}


def rules_of(task: MujocoEnv) -> TaskRules:
    """Returns the rules of a task.

    Raises:
        ValueError: for a task whose rules are not implemented.
    """
    if type(task) not in RULES:
        known = ", ".join(f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}" for kind in RULES)
        raise ValueError(
            f"{type(task).__module__}.{type(task).__name__} cannot be stepped in a batch, because its rules are not "
            f"implemented, only those of {known}; use ParallelEnv, or add its TaskRules to "
            "torchrl_h2o.envs.task_rules.RULES"
        )
    return RULES[type(task)](task)


def _within(values: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    return (bounds[0] < values) & (values < bounds[1])
