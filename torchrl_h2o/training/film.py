"""Films of a policy at work, where MuJoCo can render: with a display, or without one through EGL or OSMesa."""

import os
import sys
from pathlib import Path

from omegaconf import DictConfig

FPS = 25


def try_to_film(cfg: DictConfig, policy, directory: Path) -> Path | None:
    """A film in the run's folder; where that fails, None and a line that says why: the run is done without it."""
    try:
        return film(cfg, policy, directory / "policy.mp4")
    except Exception as error:
        print(f"\nno film: {error}")
        return None


class RenderingUnavailableError(RuntimeError):
    """MuJoCo found no OpenGL."""


def film(cfg: DictConfig, policy, path: Path, *, simulator: bool = False, seconds: float = 10.0) -> Path:
    """Films the policy in reality (or the simulator).

    Args:
        cfg: the run's configuration.
        policy: writes ``action``.
        path: an .mp4 file, or a folder (no suffix) for PNG frames.
        simulator: film in the simulator instead.
        seconds: of simulated time.

    Returns:
        The file or folder written.

    Raises:
        RenderingUnavailableError: if MuJoCo cannot render here, with what to do.
    """
    frames = _frames(cfg, policy, simulator, seconds)
    import imageio.v3 as iio

    if path.suffix == ".mp4":
        iio.imwrite(path, frames, fps=1 / (_every(cfg) * cfg.env.seconds_per_step), codec="libx264")
    else:
        path.mkdir(parents=True, exist_ok=True)
        for index, frame in enumerate(frames):
            iio.imwrite(path / f"{index:04d}.png", frame)
    return path


def _frames(cfg: DictConfig, policy, simulator: bool, seconds: float) -> list:
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")
    from torchrl_h2o.training.environments import make_reality, make_simulator
    from torchrl_h2o.training.returns import run_episode

    env = (make_simulator if simulator else make_reality)(cfg, render_mode="rgb_array")
    every = _every(cfg)
    frames, steps = [], iter(range(10**9))

    def watched(tensordict):
        if next(steps) % every == 0:
            frames.append(env.render())
        return policy(tensordict)

    env.set_seed(0)
    try:
        run_episode(env, watched, max_steps=round(seconds / cfg.env.seconds_per_step))
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


def _every(cfg: DictConfig) -> int:
    """Steps between two frames: about FPS frames a second of simulated time."""
    return max(1, round(1 / (FPS * cfg.env.seconds_per_step)))
