"""Reads the simulator inside a TorchRL env of a Gymnasium MuJoCo task."""

import numpy as np
from torchrl.envs import EnvBase

from torchrl_h2o.envs.backends.gymnasium import GymnasiumBackend
from torchrl_h2o.envs.mujoco_model import find_backend
from torchrl_h2o.residuals.simulation.settings import SIMULATION_SETTINGS, SimulationSettings
from torchrl_h2o.residuals.simulation.source import SimulatorSource
from torchrl_h2o.residuals.simulation.state_map import probe_gymnasium


def source_of_env(env: EnvBase, settings: SimulationSettings = SIMULATION_SETTINGS) -> SimulatorSource:
    """Reads the simulator inside an env, with its dynamics gaps; see :meth:`Simulation.from_env`.

    Args:
        env: a GymEnv of a MuJoCo task, with or without transforms.
        settings: tolerances of the probe that finds the state map.

    Raises:
        ValueError: if the env is no Gymnasium MuJoCo task or its observation is not linear in the state.
    """
    backend = find_backend(env)
    if not isinstance(backend, GymnasiumBackend):
        raise ValueError(
            f"{env} is no Gymnasium task, so the map from its state to its observation is unknown; use "
            "Simulation.from_mjcf with a StateMap"
        )
    task = backend.owner
    return SimulatorSource(
        spec=backend.spec,
        frame_skip=round(backend.control_step / backend.model.opt.timestep),
        state_map=probe_gymnasium(task, np.random.default_rng(0), settings),
        effects=tuple(effect for effects in backend.gaps.values() for effect in effects),
        name=task.spec.id if task.spec is not None else type(task).__name__,
    )
