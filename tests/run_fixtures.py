"""Fixtures of small runs of the recipes, in this process and as commands; all draw on one recording."""

import os
import subprocess
import sys

import hydra
import pytest

from tests.small_runs import ROBOT, ROOT, SMALL
from torchrl_h2o.training.environments import measure_observation_norm, task_of


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def command(cache, tmp_path):
    """What subprocess.run takes to run a recipe in a folder of its own."""

    def build(*overrides, script="h2o_plus.py"):
        env = os.environ | {"XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
        arguments = [sys.executable, str(ROOT / "recipes" / script), *overrides]
        return {"args": arguments, "env": env, "cwd": tmp_path, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}

    return build


@pytest.fixture
def compose(cache, monkeypatch):
    """The configuration and the real data of a small run of the robot's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))

    def build(*overrides, config="train"):
        with hydra.initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
            cfg = hydra.compose(config, [*SMALL, *ROBOT, *overrides])
        real = task_of(cfg).read_real_data(cfg.data, cfg.columns)
        measure_observation_norm(cfg, real)
        return cfg, real

    return build
