"""Simulators with dynamics gaps in them: the TorchRL transform and the environments.

Needs MuJoCo, and Gymnasium or dm_control for their tasks (``pip install torchrl_h2o[envs]``).
"""

from torchrl_h2o.envs.dynamics_gap import DynamicsGap, dynamics_gap
from torchrl_h2o.envs.mujoco_model import mujoco_model

__all__ = ["DynamicsGap", "dynamics_gap", "mujoco_model"]
