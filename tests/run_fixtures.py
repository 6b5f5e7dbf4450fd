"""Fixtures for short runs of the recipes, in this process and as commands; all of them use one cached recording."""

import os
import subprocess
import sys

import pytest

from tests.composed import composed
from tests.small_runs import ROBOT, ROOT, SMALL
from torchrl_h2o.training.environments import measure_observation_norm, task_of


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder for the recording that small runs learn from, shared by all pytest-xdist workers."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def command(cache, tmp_path):
    """Build the arguments of subprocess.run that run a recipe in the test's temporary folder."""

    def build(*overrides, script="h2o_plus.py"):
        env = os.environ | {"XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
        arguments = [sys.executable, str(ROOT / "recipes" / script), *overrides]
        return {"args": arguments, "env": env, "cwd": tmp_path, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}

    return build


@pytest.fixture
def compose(cache, monkeypatch):
    """Build the configuration and the real data of a short run on the wheel-legged robot."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))

    def build(*overrides, config="train"):
        cfg = composed(config, *SMALL, *ROBOT, *overrides)
        real = task_of(cfg).read_real_data(cfg.data, cfg.columns)
        measure_observation_norm(cfg, real)
        return cfg, real

    return build
