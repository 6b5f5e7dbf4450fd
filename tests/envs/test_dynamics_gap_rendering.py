"""Rendered frames show the changed body. Skipped without off-screen OpenGL."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
with mujoco.Renderer(model) as renderer:
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
"""


def run(arguments: list[str], backend: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "MUJOCO_GL": backend, "PYTHONWARNINGS": "ignore"}
    return subprocess.run([sys.executable, *arguments], env=environment, cwd=ROOT, capture_output=True, text=True)


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> dict[str, np.ndarray]:
    works = (gl for gl in ("egl", "osmesa") if run(["-c", PROBE], gl).returncode == 0)
    backend = next(works, None)
    if backend is None:
        pytest.skip("OpenGL draws nothing off screen here: neither EGL nor OSMesa is installed")
    path = tmp_path_factory.mktemp("rendering") / "frames.npz"
    result = run(["-m", "tests.envs.render_frames", str(path)], backend)
    assert result.returncode == 0, result.stderr
    return dict(np.load(path))


@pytest.mark.parametrize("task", ["gymnasium", "dm_control"])
def test_a_frame_shows_the_changed_body(frames, task):
    plain, changed = frames[f"{task}.plain"], frames[f"{task}.long_torso"]
    assert plain.std() > 5  # the frame is not uniform
    assert (changed != plain).any(-1).mean() > 0.02
    np.testing.assert_array_equal(frames[f"{task}.neutral"], plain)


@pytest.mark.parametrize("task", ["gymnasium", "dm_control"])
def test_an_env_that_has_drawn_before_shows_the_changed_body(frames, task):
    np.testing.assert_array_equal(frames[f"{task}.drawn_before"], frames[f"{task}.long_torso"])
