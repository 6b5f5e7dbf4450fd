"""TorchRL environments with dynamics gaps: the transform, batched simulation and the wheel-legged robot.

Requires MuJoCo, and Gymnasium or dm_control for their tasks (``pip install torchrl_h2o[envs]``).
"""

from torchrl_h2o.envs.action_history import ActionHistory
from torchrl_h2o.envs.batched_env import BatchedMujocoEnv
from torchrl_h2o.envs.dynamics_gap import DynamicsGap, dynamics_gap
from torchrl_h2o.envs.mujoco_model import mujoco_model
from torchrl_h2o.envs.recording import record
from torchrl_h2o.envs.wheel_legged.balance_controller import BalanceController, noisy_balance_controller
from torchrl_h2o.envs.wheel_legged.env import WheelLeggedEnv, WheelLeggedMujocoEnv

__all__ = [
    "ActionHistory",
    "BalanceController",
    "BatchedMujocoEnv",
    "DynamicsGap",
    "WheelLeggedEnv",
    "WheelLeggedMujocoEnv",
    "dynamics_gap",
    "mujoco_model",
    "noisy_balance_controller",
    "record",
]
