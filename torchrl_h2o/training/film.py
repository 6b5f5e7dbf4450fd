"""Films a policy. MuJoCo renders with a display or, without one, through EGL or OSMesa."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import cast

import torch
from tqdm import tqdm

from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.returns import run_episode
from torchrl_h2o.training.task import Task
from torchrl_h2o.whole_file import whole_file

FPS = 25


class RenderingUnavailableError(RuntimeError):
    """MuJoCo found no OpenGL implementation."""


def try_to_film(task: Task, preprocessing: Preprocessing, policy: torch.nn.Module, directory: Path) -> Path | None:
    """Films the policy into the run's folder. If that fails, writes a message and returns None; the run is complete."""
    try:
        return film(task, preprocessing, policy, directory / "policy.mp4")
    except Exception as error:
        tqdm.write(f"\nno film: {error}")
        return None


def film(
    task: Task,
    preprocessing: Preprocessing,
    policy: torch.nn.Module,
    path: Path,
    *,
    simulator: bool = False,
    seconds: float = 10.0,
) -> Path:
    """Films the policy in reality, or in the simulator.

    Args:
        task: the task.
        preprocessing: preprocessing of the policy's observations.
        policy: writes ``action``.
        path: an .mp4 file, or a folder (no suffix) for PNG frames.
        simulator: whether to film in the simulator.
        seconds: simulated time to film, in s.

    Returns:
        The file or folder written.

    Raises:
        RenderingUnavailableError: if MuJoCo cannot render on this machine; the message states what to install.
    """
    frames = _frames(task, preprocessing, policy, simulator, seconds)
    import imageio.v3 as iio

    if path.suffix == ".mp4":
        with whole_file(path) as partial:
            iio.imwrite(partial, frames, fps=1 / (_stride(task) * task.seconds_per_step), codec="libx264")
    else:
        path.mkdir(parents=True, exist_ok=True)
        for index, frame in enumerate(frames):
            with whole_file(path / f"{index:04d}.png") as partial:
                iio.imwrite(partial, frame)
    return path


def _frames(task: Task, preprocessing: Preprocessing, policy: torch.nn.Module, simulator: bool, seconds: float) -> list:
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")
    make = task.make_simulator if simulator else task.make_reality
    env, stride = make(None, preprocessing, render_mode="rgb_array"), _stride(task)
    frames, steps = [], iter(range(10**9))

    def watched(tensordict):
        if next(steps) % stride == 0:
            frames.append(cast(Callable, env.render)())  # a method of the environment inside
        return policy(tensordict)

    env.set_seed(0)
    try:
        run_episode(env, watched, max_steps=round(seconds / task.seconds_per_step))
    except Exception as error:
        if frames:
            raise
        raise RenderingUnavailableError(
            f"MuJoCo cannot render here ({error}). On a machine without a display install EGL or OSMesa "
            "(libegl1 or libosmesa6) and set MUJOCO_GL=egl or MUJOCO_GL=osmesa."
        ) from error
    finally:
        env.close()
    return frames


def _stride(task: Task) -> int:
    """Control steps between two frames, for about ``FPS`` frames per second of simulated time."""
    return max(1, round(1 / (FPS * task.seconds_per_step)))
