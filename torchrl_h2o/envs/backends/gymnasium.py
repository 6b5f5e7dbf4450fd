"""The simulation inside a Gymnasium MuJoCo task in TorchRL's GymEnv or GymWrapper."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
from torchrl.envs import EnvBase, GymWrapper

from torchrl_h2o.envs.backends.backend import MujocoBackend

if TYPE_CHECKING:
    from gymnasium.envs.mujoco import MujocoEnv


class GymnasiumBackend(MujocoBackend):
    """A :class:`gymnasium.envs.mujoco.MujocoEnv`, with the model of the file ``fullpath``."""

    owner: MujocoEnv
    env: GymWrapper

    @classmethod
    def inside(cls, env: EnvBase) -> GymnasiumBackend | None:
        """Returns the backend of an env without transforms; None for an env of another kind."""
        if not isinstance(env, GymWrapper):
            return None
        from gymnasium.envs.mujoco import MujocoEnv

        task = getattr(env._env, "unwrapped", None)
        return cls(task, env) if isinstance(task, MujocoEnv) else None

    @property
    def model(self) -> mujoco.MjModel:
        return self.owner.model

    @property
    def data(self) -> mujoco.MjData:
        return self.owner.data

    @property
    def control_step(self) -> float:
        return self.owner.dt * self.env.wrapper_frame_skip

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(self.owner.fullpath)

    @property
    def source(self) -> str:
        return self.owner.fullpath

    def generator(self) -> np.random.Generator:
        return np.random.default_rng(self.owner.np_random.integers(2**63))

    def load(self, model: mujoco.MjModel) -> None:
        task, old = self.owner, self.owner.model
        task.model, task.data = model, mujoco.MjData(model)
        # coordinates that start at the model's qpos0 follow the new model; a task's own initial values stay
        task.init_qpos = np.where(task.init_qpos == old.qpos0, model.qpos0, task.init_qpos)
        renderer = task.mujoco_renderer
        renderer.close()  # its contexts contain the old model's geometry
        renderer._viewers.clear()
        renderer.viewer = None
        renderer.model, renderer.data = task.model, task.data

    def push(self) -> None:
        # a method rather than a lambda, so that a copy of the task steps its own simulation
        self.owner._step_mujoco_simulation = self._step

    def _step(self, ctrl: np.ndarray, n_frames: int) -> None:
        step = type(self.owner)._step_mujoco_simulation
        self.data.ctrl[:] = ctrl  # forces read the controls before the step writes them
        self._pushed_steps(lambda: step(self.owner, ctrl, 1), n_frames)
