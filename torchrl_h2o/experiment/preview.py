"""A film of the motion that an experiment is expected to make, to look at before a machine makes it."""

from __future__ import annotations

import copy
import os
import sys
from pathlib import Path

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from PIL import Image

from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.whole_file import whole_file

FPS = 10
SIZE = 320, 320  # pixels


def film_motion(simulation: Simulation, states: np.ndarray, path: Path) -> None:
    """Films a motion as an animated GIF, at its real speed.

    Args:
        simulation: the simulator that made it.
        states: before each action and after the last one, (T + 1, nq + nv).
        path: the file.

    Raises:
        Exception: of MuJoCo, if it cannot render on this machine.
    """
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")
    model = copy.copy(simulation.model)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
    data = mujoco.MjData(model)
    camera = {"lookat": model.stat.center, "distance": 2.0 * model.stat.extent, "azimuth": 100.0, "elevation": -15.0}
    renderer = MujocoRenderer(model, data, camera, width=SIZE[0], height=SIZE[1])
    frames, stride = [], max(1, round(1.0 / (FPS * simulation.control_step)))
    try:
        for state in states[::stride]:
            data.qpos[:], data.qvel[:] = np.split(state, [model.nq])
            mujoco.mj_forward(model, data)
            frames.append(Image.fromarray(np.asarray(renderer.render("rgb_array"))))
    finally:
        renderer.close()
    first, *rest = frames
    duration = round(1000 * stride * simulation.control_step)  # ms
    with whole_file(path) as partial:
        first.save(partial, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0)
