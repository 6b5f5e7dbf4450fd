"""Settings for all tests: one thread per worker, and no time limit on Hypothesis examples."""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when torch and NumPy load, here and in the processes that tests start

from pathlib import Path

import pytest
import torch
from hypothesis import settings
from matplotlib.figure import Figure

pytest_plugins = ["tests.run_fixtures"]

torch.set_num_threads(1)
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture
def saved_figures(monkeypatch):
    """Matplotlib's figures in the order in which they are saved as files."""
    figures, save = [], Figure.savefig

    def saved(figure, *args, **kwargs):
        figures.append(figure)
        save(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", saved)
    return figures


@pytest.fixture
def shared_data():
    """Returns the folder of published recordings, which are not part of the repository."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TORCHRL_H2O_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set TORCHRL_H2O_TEST_DATA")
    return folder
