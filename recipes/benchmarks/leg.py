"""A leg with three motors as a Gymnasium task, whose joints may differ in friction and rotor inertia."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

MODEL_PATH = Path(__file__).with_name("leg.xml")
JOINTS = ("abduction", "flexion", "knee")
CONTROL_STEP = 0.005  # s
FRAME_SKIP = 2
NO_REWARD = 0.0  # the benchmark trains no policy


class LegEnv(MujocoEnv):
    """Observes the angles (rad) and angular velocities (rad/s) of the joints; the actions are torques, in N·m."""

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own attribute)
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": round(1.0 / CONTROL_STEP),
    }

    def __init__(self) -> None:
        super().__init__(str(MODEL_PATH), FRAME_SKIP, Box(-np.inf, np.inf, (6,), np.float64))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), NO_REWARD, False, False, {}

    def reset_model(self) -> np.ndarray:
        self.set_state(self.np_random.uniform(-0.3, 0.3, 3), self.np_random.uniform(-1.0, 1.0, 3))
        return self._get_obs()

    def _get_obs(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])
