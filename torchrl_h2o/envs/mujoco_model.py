"""Finds the MuJoCo simulation of a TorchRL env and its model."""

import mujoco
from torchrl.envs import EnvBase, MujocoEnv

from torchrl_h2o.envs.backends.backend import MujocoBackend, base_env
from torchrl_h2o.envs.backends.dm_control import DMControlBackend
from torchrl_h2o.envs.backends.gymnasium import GymnasiumBackend


def mujoco_model(env: EnvBase) -> mujoco.MjModel:
    """Returns the MuJoCo model in use, with all of the env's dynamics gaps applied.

    Applying a gap replaces the model, so call this function again instead of keeping the result.

    Args:
        env: a GymEnv or DMControlEnv of a MuJoCo task, with or without transforms.

    Returns:
        The model itself, not a copy.

    Raises:
        ValueError: if the env is batched or does not run on MuJoCo.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> float(mujoco_model(GymEnv("HalfCheetah-v5")).opt.gravity[2])
        -9.81
    """
    return find_backend(env).model


def find_backend(env: EnvBase) -> MujocoBackend:
    """Returns the backend of an env: access to its MuJoCo simulation.

    Args:
        env: a GymEnv or DMControlEnv of a MuJoCo task, with or without transforms.

    Returns:
        The backend.

    Raises:
        ValueError: if the env is batched or does not run on MuJoCo.
    """
    base = base_env(env)
    if isinstance(base, MujocoEnv):
        raise ValueError(
            f"{type(base).__name__} is TorchRL's own MujocoEnv, which keeps a copy of its model where no gap reaches "
            "it; choose the task of Gymnasium or dm_control, such as GymEnv('Hopper-v5') or "
            "DMControlEnv('hopper', 'hop')"
        )
    if base.batch_size:
        raise ValueError(
            f"{base} is batched, with batch size {tuple(base.batch_size)}: its simulations are not accessible from "
            "outside. Put the gap inside each worker, as in "
            "ParallelEnv(2, lambda: TransformedEnv(GymEnv('HalfCheetah-v5'), DynamicsGap(...)))"
        )
    backend = GymnasiumBackend.inside(base) or DMControlBackend.inside(base)
    if backend is None:
        raise ValueError(
            f"{base} does not run on MuJoCo; choose a MuJoCo task of Gymnasium, such as "
            "GymEnv('HalfCheetah-v5'), or of dm_control, such as DMControlEnv('cheetah', 'run')"
        )
    return backend
