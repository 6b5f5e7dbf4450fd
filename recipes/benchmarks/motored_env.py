"""Mechanisms with motors as Gymnasium tasks, observed by the positions and velocities of all joints."""

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

from torchrl_h2o.envs.task_rules import RULES, TaskRules

NO_REWARD = 0.0  # of mechanisms in which no policy is trained
LEG_JOINTS = ("abduction", "flexion", "knee")
PENDULUM_STEP = 0.01  # s


class MotoredEnv(MujocoEnv):
    """Observes positions and velocities of all joints, hinges or slides; the actions are torques or forces.

    Args:
        model: path of the MJCF file from the folder of this file.
        frame_skip: physics steps per control step.
        control_step: control step, in s.
        start_angle: largest position of a joint at the start of an episode, in rad or m; positions are uniform, as are
            velocities up to 1 rad/s or m/s.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own attribute)
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]
    }

    def __init__(self, model: str, frame_skip: int, control_step: float, start_angle: float) -> None:
        # MujocoEnv compares the frames per second with the model
        self.metadata = {**self.metadata, "render_fps": round(1.0 / control_step)}
        self._start_angle = start_angle
        super().__init__(str(Path(__file__).parent / model), frame_skip, None)
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


class PendulumEnv(MotoredEnv):
    """A pendulum with one motor; an angle of 0 hangs down, and episodes start at any angle."""

    def __init__(self) -> None:
        super().__init__("pendulum.xml", 4, PENDULUM_STEP, start_angle=math.pi)

    @classmethod
    def critical_damping(cls) -> float:
        """Viscous friction at which small swings just do not overshoot, in N·m·s/rad: 2 √(m g l · m l²)."""
        model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("pendulum.xml")))
        mass, length = float(model.body("arm").mass[0]), -float(model.body("arm").ipos[2])
        weight = -float(model.opt.gravity[2]) * mass
        return 2.0 * math.sqrt(weight * length * mass * length**2)


class LegEnv(MotoredEnv):
    """A leg with three motors, whose joints may differ in friction and rotor inertia; it starts near hanging."""

    def __init__(self) -> None:
        super().__init__("leg.xml", 2, 0.005, start_angle=0.3)


class CartPoleEnv(MotoredEnv):
    """A pole that hangs from a driven cart."""

    def __init__(self) -> None:
        super().__init__("machines/cart_pole.xml", 4, 0.01, start_angle=0.3)


class TwoLinksEnv(MotoredEnv):
    """Two hanging links with a motor at each joint."""

    def __init__(self) -> None:
        super().__init__("machines/two_links.xml", 4, 0.005, start_angle=0.3)


class ReachingEnv(TwoLinksEnv):
    """The two links as an arm that moves its tip to a point and holds it there against its weight."""

    lengths = 0.35, 0.3  # m, of the two links
    target = np.array([-0.42, -0.47])  # m, x and z of the point
    strongest = np.array([6.0, 2.0], np.float32)  # N·m

    def _set_action_space(self) -> Box:
        self.action_space = Box(-self.strongest, self.strongest)  # the model's motors have no bounds
        return self.action_space

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        observation, _, *others = super().step(action)
        return observation, -float(self.distance(self.data.qpos)), *others

    def distance(self, qpos: np.ndarray) -> np.ndarray:
        """Distance of the tip from the point in m, (...), at joint angles (..., 2)."""
        upper, lower = qpos[..., 0], qpos[..., 0] + qpos[..., 1]
        turned = np.stack([[np.sin(angle), np.cos(angle)] for angle in (upper, lower)])  # (2 links, x and z, ...)
        tip = -np.tensordot(self.lengths, turned, 1)
        return np.hypot(tip[0] - self.target[0], tip[1] - self.target[1])


class Reaching(TaskRules):
    """The arm's rules for many worlds at once: the reward is the negative distance of the tip from its point, in m."""

    task: ReachingEnv

    def observe(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return np.concatenate([qpos, qvel], axis=1)

    def reward(
        self, before: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray, control_step: np.ndarray
    ) -> np.ndarray:
        return -self.task.distance(qpos)

    def is_terminated(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        return np.zeros(len(qpos), dtype=bool)


RULES[ReachingEnv] = Reaching
