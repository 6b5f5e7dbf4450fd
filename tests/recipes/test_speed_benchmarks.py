"""The benchmarks of speed leave a table and a file, with what they compare to measured in the same run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "recipes" / "benchmarks"


def run(script, folder, *overrides):
    command = [sys.executable, BENCHMARKS / script, f"hydra.run.dir={folder}", *overrides]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_updates_are_set_beside_a_textbook_s_and_beside_the_limit(tmp_path):
    out = run("update.py", tmp_path, "seconds=0.1", "turns=1", "compiled=false", "transitions=1000", "threads=1")
    result = json.loads((tmp_path / "update.json").read_text())
    assert result["flop"] / 1e9 == pytest.approx(1.21, rel=0.05)  # of the authors' update, on HalfCheetah
    assert result["limit"] == result["gflop_per_second"] * 1e9 / result["flop"]
    assert {"textbook", "ours", "SAC, TorchRL's loss", "SAC of our parts"} == set(result["updates_per_second"])
    assert 0.0 < result["updates_per_second"]["ours"] < result["limit"]
    assert "of the limit" in out


def test_steps_are_set_beside_bare_rollouts(tmp_path):
    out = run("simulator.py", tmp_path, "seconds=0.1", "turns=1", "worlds=[1,16]")
    rates = json.loads((tmp_path / "simulator.json").read_text())["steps_per_second"]
    assert rates["BatchedMujocoEnv, 16"] > rates["BatchedMujocoEnv, 1"]
    assert rates["mujoco.rollout, 16"] > rates["BatchedMujocoEnv, 16"]
    assert "of mujoco.rollout" in out
