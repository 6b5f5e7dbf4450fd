"""The paper's wheel-legged robot, and the controller that records its data."""

from torchrl_h2o.envs.wheel_legged.env import (
    MAX_PITCH,
    OBSERVATIONS,
    TARGET_VELOCITY,
    WheelLeggedEnv,
    WheelLeggedMujocoEnv,
    reward,
)

__all__ = ["MAX_PITCH", "OBSERVATIONS", "TARGET_VELOCITY", "WheelLeggedEnv", "WheelLeggedMujocoEnv", "reward"]
