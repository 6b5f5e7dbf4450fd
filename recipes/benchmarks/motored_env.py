"""A mechanism with a motor at each joint as a Gymnasium task, observed by its joints' angles and velocities."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

NO_REWARD = 0.0  # the benchmark trains no policy


class MotoredEnv(MujocoEnv):
    """Observes angles (rad) and angular velocities (rad/s) of all joints; the actions are torques, in N·m.

    Args:
        model: MJCF file of hinge joints.
        frame_skip: physics steps per control step.
        control_step: control step, in s.
        start_angle: largest angle of a joint at the start of an episode, in rad; angles are uniform, as are velocities
            up to 1 rad/s.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own attribute)
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]
    }

    def __init__(self, model: Path, frame_skip: int, control_step: float, start_angle: float) -> None:
        self.metadata = {
            **self.metadata,
            "render_fps": round(1.0 / control_step),
        }  # MujocoEnv compares it with the model
        self._start_angle = start_angle
        super().__init__(str(model), frame_skip, None)
        self.observation_space = Box(-np.inf, np.inf, (self.model.nq + self.model.nv,), np.float64)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), NO_REWARD, False, False, {}

    def reset_model(self) -> np.ndarray:
        angles = self.np_random.uniform(-self._start_angle, self._start_angle, self.model.nq)
        self.set_state(angles, self.np_random.uniform(-1.0, 1.0, self.model.nv))
        return self._get_obs()

    def _get_obs(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])
