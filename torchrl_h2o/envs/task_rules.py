"""What Gymnasium's MuJoCo tasks observe, pay for and end at, of many worlds at once.

Each is Gymnasium's own formula, with the constants of the task object: the tests hold them against it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

from torchrl_h2o.envs.wheel_legged.env import MAX_PITCH, WheelLeggedMujocoEnv, reward

if TYPE_CHECKING:
    from gymnasium.envs.mujoco import MujocoEnv


class TaskRules(ABC):
    """The rules of one task.

    Args:
        task: an object of it, whose constants are read.
    """

    def __init__(self, task: MujocoEnv) -> None:
        self.task = task

    @abstractmethod
    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """The observations, (N, n), of states (N, nq) and (N, nv): a new array, as the env goes on writing to those."""

    @abstractmethod
    def reward(
        self, before: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray, control_step: np.ndarray
    ) -> np.ndarray:
        """The rewards, (N), of going from positions ``before`` (N, nq) to states, by actions (N, nu).

        Args:
            before: positions where the step began.
            qpos: positions where it ended.
            qvel: velocities where it ended.
            action: as the simulator was given them.
            control_step: of each world, (N), in s.
        """

    @abstractmethod
    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Whether episodes end in these states, (N)."""


class Running(TaskRules):
    """HalfCheetah: forward velocity, less the effort; it never ends."""

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
    """Walker2d: the same, velocities cut off, pay for being healthy, and an end when it is not."""

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return super().observe(qpos, np.clip(qvel, -10.0, 10.0))

    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        if not self.task._terminate_when_unhealthy:
            return super().is_terminated(qpos, qvel)
        return ~self._is_healthy(qpos, qvel)

    def _survival(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return self._is_healthy(qpos, qvel) * self.task._healthy_reward

    def _is_healthy(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return _within(qpos[:, 1], self.task._healthy_z_range) & _within(qpos[:, 2], self.task._healthy_angle_range)


class Hopping(Walking):
    """Hopper: the same, and healthy only while no other coordinate is far off."""

    def _is_healthy(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        rest = np.concatenate([qpos[:, 2:], qvel], axis=1)
        return super()._is_healthy(qpos, qvel) & _within(rest, self.task._healthy_state_range).all(1)


class Balancing(TaskRules):
    """The wheel-legged robot."""

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
        return ~(np.abs(qpos[:, 2]) <= MAX_PITCH)  # a pitch that is not a number counts as lost


RULES: dict[type[MujocoEnv], type[TaskRules]] = {
    HalfCheetahEnv: Running,
    HopperEnv: Hopping,
    Walker2dEnv: Walking,
    WheelLeggedMujocoEnv: Balancing,
}


def rules_of(task: MujocoEnv) -> TaskRules:
    """The rules of a task.

    Raises:
        ValueError: for a task that has none here.
    """
    if type(task) not in RULES:
        known = ", ".join(kind.__name__ for kind in RULES)
        raise ValueError(
            f"the rules of {type(task).__name__} are not known to step it in a batch, only those of {known}; take "
            "ParallelEnv, or add a TaskRules of it to torchrl_h2o.envs.task_rules.RULES"
        )
    return RULES[type(task)](task)


def _within(values: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    return (bounds[0] < values) & (values < bounds[1])
