"""A film of the motion that an experiment is expected to make, to look at before a machine makes it.

python preview.py MODEL.mjb STATES.npy SECONDS FILM.gif    # in a process of its own, because OpenGL may end a process
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from torchrl_h2o.residuals.simulation.simulation import Simulation

FPS = 10
SIZE = 320, 320  # pixels
WITHIN = 120  # s, after which a film is given up


def film_motion(simulation: Simulation, states: np.ndarray, path: Path) -> None:
    """Films a motion as an animated GIF, at its real speed, in a second process.

    Args:
        simulation: the simulator that made it.
        states: before each action and after the last one, (T + 1, nq + nv).
        path: the file.

    Raises:
        RuntimeError: if MuJoCo cannot render on this machine.
    """
    stride = max(1, round(1.0 / (FPS * simulation.control_step)))
    with tempfile.TemporaryDirectory() as folder:
        model, shown, film = (Path(folder) / name for name in ("model.mjb", "states.npy", "film.gif"))
        mujoco.mj_saveModel(simulation.model, str(model))
        np.save(shown, states[::stride])
        command = [sys.executable, __file__, model, shown, str(stride * simulation.control_step), film]
        gl = {} if sys.platform != "linux" or "DISPLAY" in os.environ else {"MUJOCO_GL": "egl"}
        try:
            subprocess.run(command, env=gl | os.environ, capture_output=True, text=True, timeout=WITHIN, check=True)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            told = str(error.stderr or error).strip().splitlines()[-1]
            raise RuntimeError(
                f"MuJoCo cannot render here ({told}). On a machine without a display install EGL or OSMesa and set "
                "MUJOCO_GL=egl or MUJOCO_GL=osmesa."
            ) from error
        path.write_bytes(film.read_bytes())


def _film(model_file: str, states_file: str, seconds: str, path: str) -> None:
    """Renders states, one a frame of some seconds, into a GIF."""
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
    from PIL import Image

    model, states = mujoco.MjModel.from_binary_path(model_file), np.load(states_file)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
    data = mujoco.MjData(model)
    camera = {"lookat": model.stat.center, "distance": 2.0 * model.stat.extent, "azimuth": 100.0, "elevation": -15.0}
    renderer = MujocoRenderer(model, data, camera, width=SIZE[0], height=SIZE[1])
    frames = []
    for state in states:
        data.qpos[:], data.qvel[:] = np.split(state, [model.nq])
        mujoco.mj_forward(model, data)
        frames.append(Image.fromarray(np.asarray(renderer.render("rgb_array"))))
    first, *rest = frames
    first.save(path, save_all=True, append_images=rest, duration=round(1000 * float(seconds)), loop=0)


if __name__ == "__main__":
    _film(*sys.argv[1:])
