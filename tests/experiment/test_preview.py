"""The film of an expected motion, rendered in a process of its own."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from tests.residuals.pendulum import double_pendulum
from torchrl_h2o.experiment.preview import film_motion
from torchrl_h2o.experiment.separation import Motion

SIMULATION = double_pendulum()


@pytest.mark.slow
def test_a_film_has_ten_frames_a_second(tmp_path):
    commands = 0.3 * np.sin(0.1 * np.arange(100))[:, None] * np.ones(2)
    motion = Motion.of(SIMULATION, np.zeros(4), commands)  # 1 s
    try:
        film_motion(SIMULATION, motion.states, tmp_path / "film.gif")
    except RuntimeError as error:
        pytest.skip(str(error))
    film = Image.open(tmp_path / "film.gif")
    frames = [np.asarray(frame.convert("RGB"), dtype=float) for frame in ImageSequence.Iterator(film)]
    assert (len(frames), film.info["duration"]) == (11, 100)
    assert np.abs(frames[0] - frames[8]).max() > 50.0


def test_a_process_that_cannot_render_is_an_error_that_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no such renderer")
    with pytest.raises(RuntimeError, match="install EGL or OSMesa"):
        film_motion(SIMULATION, np.zeros((5, 4)), tmp_path / "film.gif")
    assert not (tmp_path / "film.gif").exists()
