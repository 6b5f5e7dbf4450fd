"""Renders envs with and without a gap: python -m tests.envs.render_frames FRAMES.npz.

Runs as a separate process, because OpenGL aborts the process on an error.
"""

import sys

import numpy as np
from torchrl.envs import DMControlEnv, GymEnv, TransformedEnv

from torchrl_h2o.envs import dynamics_gap


def gymnasium_env() -> GymEnv:
    return GymEnv("HalfCheetah-v5", render_mode="rgb_array", width=160, height=120)


def gymnasium_frame(env: GymEnv) -> np.ndarray:
    env.set_seed(0)
    env.reset()
    return env._env.render()


def dm_control_frame(env: DMControlEnv) -> np.ndarray:
    env.set_seed(0)
    env.reset()
    return env._env.physics.render(120, 160, camera_id="side")


def draw(make, frame) -> dict[str, np.ndarray]:
    drawn_before = make()
    return {
        "plain": frame(drawn_before),
        "neutral": frame(TransformedEnv(make(), dynamics_gap("gravity", 1.0)).base_env),
        "long_torso": frame(TransformedEnv(make(), dynamics_gap("long_torso")).base_env),
        "drawn_before": frame(TransformedEnv(drawn_before, dynamics_gap("long_torso")).base_env),
    }


if __name__ == "__main__":
    tasks = {
        "gymnasium": draw(gymnasium_env, gymnasium_frame),
        "dm_control": draw(lambda: DMControlEnv("cheetah", "run"), dm_control_frame),
    }
    frames = {f"{task}.{name}": f for task, drawn in tasks.items() for name, f in drawn.items()}
    np.savez(sys.argv[1], **frames)
