"""The paper's wheel-legged robot: reward, Gymnasium task and TorchRL env.

The model is this package's own MJCF, wheel_legged.xml. The differences between simulator and reality are effects; see
torchrl_h2o/config/env/wheel_legged.yaml.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from gymnasium import utils
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit
from torchrl.envs import GymWrapper

if TYPE_CHECKING:
    import torch

    Array = TypeVar("Array", np.ndarray, torch.Tensor)

MODEL_PATH = Path(__file__).with_name("wheel_legged.xml")
#: the observed quantities of each task, in this order, in m, m/s, rad and rad/s
OBSERVATIONS = {
    "standing_still": ("theta", "theta_dot", "x", "v"),
    "moving_forward": ("v", "theta", "theta_dot"),
}
# definitions of the paper's tasks and dimensions of its robot, not thresholds
TARGET_VELOCITY = 0.2  # m/s, of the task moving_forward
MAX_PITCH = math.pi / 6  # rad; an episode terminates beyond it
FRAME_SKIP = 2  # physics steps of 2.5 ms per control step: 200 Hz
WHEEL_RADIUS = 0.065  # m


def reward(task: str, observation: Array, action: Array, next_observation: Array) -> Array:
    r"""Returns the reward of transitions, both from the env and from measured data.

    * ``standing_still``: :math:`30 - x^2 - v^2 - \theta^2 - \dot\theta^2 - \tau^2`
    * ``moving_forward``: :math:`15 - (v - 0.2)^2 - \tau^2`

    The state variables are those of the next state; :math:`\tau` is the torque of ``action``. The env uses the executed
    torque, which differs from the commanded one under an effect that alters actions.

    Args:
        task: a key of :data:`OBSERVATIONS`.
        observation: observation before the transition, (..., 4) or (..., 3). Neither formula uses it; it keeps the
            signature of a reward function of the data readers.
        action: torque in N·m, (..., 1).
        next_observation: observation after the transition, of the same shape.

    Returns:
        The rewards, (...), a NumPy array or torch tensor like ``next_observation``, with its dtype.

    Raises:
        ValueError: for an unknown task.

    Example:
        >>> import numpy as np
        >>> upright, pushed = np.zeros(4), np.array([0.1, 0.0, 1.0, 0.0])
        >>> float(reward("standing_still", upright, np.array([2.0]), pushed))
        24.99

    Source: Niu, Ji, et al., H2O+ (2023), arXiv 2309.12716, section on the real-world experiments.
    """
    effort = (action * action).sum(-1)
    if task == "standing_still":
        return cast("Array", 30.0 - (next_observation * next_observation).sum(-1) - effort)
    if task == "moving_forward":
        return cast("Array", 15.0 - (next_observation[..., 0] - TARGET_VELOCITY) ** 2 - effort)
    raise ValueError(_unknown_task(task))


def _unknown_task(task: str) -> str:
    return f"the wheel-legged robot has no task {task!r}; choose one of {', '.join(OBSERVATIONS)}"


class WheelLeggedMujocoEnv(MujocoEnv, utils.EzPickle):
    r"""The robot as a Gymnasium MuJoCo task: a body on two rigid legs, balancing on two wheels.

    It moves in its sagittal plane. ``theta`` is the pitch (positive when leaning forward), ``x`` the displacement of
    the axle along the floor and ``v`` its velocity: the rotation of the wheels times their radius, corrected for the
    pitch of the body. (This definition fits the log of the real robot slightly better than the rotation of the wheels
    relative to the body, and it reproduces the 12 kg and 0.065 m of the paper.) The action is the torque of each of
    the two wheel motors, in N·m; both receive the same. The opposite torque acts on the body.

    The mass distribution is matched to the real robot's log. A planar wheeled pendulum of 12 kg with two motors,
    fitted to 100 ms windows of the log, has its centre of mass 0.15 m above the axle and falls as :math:`e^{9t}`; a
    torque of 1 N·m changes ``v`` by 6.8 m/s² and ``theta_dot`` by -32 to -36 rad/s². This model has 0.15 m,
    :math:`e^{9.0t}`, 6.7 m/s² and -33 rad/s². Delay and friction, which the log also shows, are effects.

    Args:
        task: ``"standing_still"`` or ``"moving_forward"``; sets observation and reward.
        reset_noise: bound of the uniform distribution of the initial pitch (rad) and pitch rate (rad/s).
        render_mode: ``None``, ``"human"``, ``"rgb_array"``, ``"depth_array"``, ``"rgbd_tuple"``.
        **kwargs: further arguments of :class:`gymnasium.envs.mujoco.MujocoEnv`, such as
            ``width`` and ``height``.

    Raises:
        ValueError: for an unknown task, or a reset noise that is negative or reaches the pitch of termination.

    Example:
        >>> import numpy as np
        >>> env = WheelLeggedMujocoEnv("standing_still")
        >>> observation, _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        >>> observation.shape, terminated
        ((4,), False)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium's own attribute)
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": 200,
    }
    #: usual values of unobserved velocities as linear functions of observed ones: wheels that roll without slip
    hidden_state: Mapping[str, Mapping[str, float]] = MappingProxyType(
        {"axle_velocity": {"x_velocity": 1.0 / WHEEL_RADIUS, "pitch_velocity": -1.0}}
    )

    def __init__(
        self,
        task: str = "standing_still",
        reset_noise: float = 0.05,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        utils.EzPickle.__init__(self, task, reset_noise, render_mode, **kwargs)
        if task not in OBSERVATIONS:
            raise ValueError(_unknown_task(task))
        if not 0.0 <= reset_noise < MAX_PITCH:
            raise ValueError(
                f"reset_noise is {reset_noise}; it must lie in [0, pi/6), because episodes terminate at a pitch of pi/6"
            )
        self.task = task
        self.reset_noise = reset_noise
        kwargs.setdefault("camera_name", "side")
        super().__init__(
            str(MODEL_PATH),
            FRAME_SKIP,
            Box(-np.inf, np.inf, (len(OBSERVATIONS[task]),), np.float32),
            render_mode=render_mode,
            **kwargs,
        )

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.floating, bool, bool, dict]:
        self.do_simulation(action, self.frame_skip)
        observation = self._get_obs()
        if self.render_mode == "human":
            self.render()
        # this form also terminates for a NaN pitch
        terminated = not abs(self.data.qpos[2]) <= MAX_PITCH
        # the observation before the step is not stored, because neither reward uses it
        value = cast("np.floating", reward(self.task, observation, action, observation))
        return observation, value, terminated, False, {}

    def reset_model(self) -> np.ndarray:
        pitch, pitch_rate = self.np_random.uniform(-self.reset_noise, self.reset_noise, 2)
        qpos, qvel = self.init_qpos.copy(), self.init_qvel.copy()
        qpos[2] = pitch
        # the wheels rest on the floor, so they turn relative to the body as it pitches
        qvel[2], qvel[3] = pitch_rate, -pitch_rate
        self.set_state(qpos, qvel)
        return self._get_obs()

    def _get_obs(self) -> np.ndarray:
        (x, _, theta, _), (v, _, theta_dot, _) = self.data.qpos, self.data.qvel
        if self.task == "standing_still":
            return np.array((theta, theta_dot, x, v), np.float32)
        return np.array((v, theta, theta_dot), np.float32)


class WheelLeggedEnv(GymWrapper):
    """The robot as a TorchRL env: :class:`WheelLeggedMujocoEnv` with a time limit.

    An episode is truncated after ``max_episode_steps`` and terminated when the robot falls. Effects are added as to
    any other env: ``TransformedEnv(WheelLeggedEnv(), DynamicsGap(...))``.

    Args:
        task: ``"standing_still"``, which observes (theta, theta_dot, x, v), or
            ``"moving_forward"``, which observes (v, theta, theta_dot).
        max_episode_steps: steps of 5 ms; the default is 30 s.
        reset_noise: see :class:`WheelLeggedMujocoEnv`.
        render_mode: see :class:`WheelLeggedMujocoEnv`.
        width: width of rendered frames, in pixels.
        height: height of rendered frames, in pixels.
        **kwargs: further arguments of :class:`torchrl.envs.GymWrapper`, such as ``from_pixels``.

    Example:
        >>> env = WheelLeggedEnv("moving_forward")
        >>> env.set_seed(0)  # doctest: +SKIP
        >>> rollout = env.rollout(5)
        >>> rollout["observation"].shape, rollout["next", "reward"].shape
        (torch.Size([5, 3]), torch.Size([5, 1]))
    """

    def __init__(
        self,
        task: str = "standing_still",
        *,
        max_episode_steps: int = 6000,
        reset_noise: float = 0.05,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **kwargs: Any,
    ) -> None:
        robot = WheelLeggedMujocoEnv(task, reset_noise, render_mode, width=width, height=height)
        super().__init__(env=TimeLimit(robot, max_episode_steps), **kwargs)
