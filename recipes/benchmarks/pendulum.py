"""A pendulum as a Gymnasium task, the smallest system of the benchmark."""

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

MODEL_PATH = Path(__file__).with_name("pendulum.xml")
CONTROL_STEP = 0.01  # s
FRAME_SKIP = 4
NO_REWARD = 0.0  # the benchmark trains no policy


class PendulumEnv(MujocoEnv):
    """Observes angle (rad, 0 hangs down) and angular velocity (rad/s); the action is the torque on the axis, in N·m."""

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own attribute)
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": round(1.0 / CONTROL_STEP),
    }

    def __init__(self) -> None:
        super().__init__(str(MODEL_PATH), FRAME_SKIP, Box(-np.inf, np.inf, (2,), np.float64))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), NO_REWARD, False, False, {}

    def reset_model(self) -> np.ndarray:
        self.set_state(self.np_random.uniform(-np.pi, np.pi, 1), self.np_random.uniform(-1.0, 1.0, 1))
        return self._get_obs()

    @classmethod
    def critical_damping(cls) -> float:
        """Viscous friction at which small swings just do not overshoot, in N·m·s/rad: 2 √(m g l · m l²)."""
        model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
        mass, length = float(model.body("arm").mass[0]), -float(model.body("arm").ipos[2])
        weight = -float(model.opt.gravity[2]) * mass
        return 2.0 * math.sqrt(weight * length * mass * length**2)

    def _get_obs(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])
