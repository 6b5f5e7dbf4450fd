"""The simulation inside a dm_control suite task in TorchRL's DMControlEnv."""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from torchrl.envs import DMControlWrapper, EnvBase

from torchrl_h2o.envs.backends.backend import MujocoBackend

if TYPE_CHECKING:
    from dm_control.mujoco import Physics


# fields by the task's module; dm_control assigns them in initialize_episode
_WRITTEN_AT_RESET = {
    "finger": ("site_rgba", "site_pos", "site_size", "dof_damping"),
    "fish": ("geom_rgba", "geom_pos"),
    "point_mass": ("wrap_prm",),
    "reacher": ("geom_size", "geom_pos"),
}


class DMControlBackend(MujocoBackend):
    """A dm_control ``Physics``, with the model that the task's module builds."""

    owner: Physics
    env: DMControlWrapper

    @classmethod
    def inside(cls, env: EnvBase) -> DMControlBackend | None:
        """Returns the backend of an env without transforms; None for an env of another kind."""
        return cls(env._env.physics, env) if isinstance(env, DMControlWrapper) else None

    @property
    def model(self) -> mujoco.MjModel:
        return self.owner.model.ptr

    @property
    def data(self) -> mujoco.MjData:
        return self.owner.data.ptr

    @property
    def control_step(self) -> float:
        return self.env._env.control_timestep() * self.env.wrapper_frame_skip

    def spec(self) -> mujoco.MjSpec:
        get = getattr(self._module, "get_model_and_assets", None)
        if get is None:
            raise ValueError(
                f"{self.env}: {self._module.__name__} has no function get_model_and_assets, from which most tasks of "
                "dm_control.suite load their model; choose one of those"
            )
        asked = [p.name for p in inspect.signature(get).parameters.values() if p.default is p.empty]
        if asked:
            raise ValueError(
                f"{self.env}: {self.source} builds the model from arguments ({', '.join(asked)}) that the task does "
                "not store, so the model cannot be rebuilt; choose a task whose model is a file"
            )
        xml, assets = get()
        return mujoco.MjSpec.from_string(xml.decode(), include=assets, assets=assets)

    @property
    def source(self) -> str:
        return f"{self._module.__name__}.get_model_and_assets"

    @property
    def written_at_reset(self) -> tuple[str, ...]:
        package, _, domain = self._module.__name__.rpartition(".")
        return _WRITTEN_AT_RESET.get(domain, ()) if package == "dm_control.suite" else ()

    @property
    def _module(self) -> ModuleType:
        return sys.modules[type(self.env._env.task).__module__]

    def generator(self) -> np.random.Generator:
        return np.random.default_rng(self.env._env.task.random.randint(2**31 - 1))

    def load(self, model: mujoco.MjModel) -> None:
        from dm_control.mujoco.wrapper import MjModel

        # Physics.reload_from_xml_string does the same, but rounds numbers when it writes them as text. This call also
        # renews the named views and the rendering contexts.
        self.owner._reload_from_model(MjModel(model))

    def push(self) -> None:
        self.owner.step = self._step

    def _step(self, nstep: int = 1) -> None:
        step = type(self.owner).step
        self._pushed_steps(lambda: step(self.owner, 1), nstep)
