"""The speed benchmarks write a table and a file, and measure their references in the same run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from growth import Rate, pays_until

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).parents[3] / "recipes" / "benchmarks"


def run(script, folder, *overrides):
    command = [sys.executable, BENCHMARKS / script, f"hydra.run.dir={folder}", *overrides]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_updates_are_set_beside_a_textbook_s_and_beside_the_limit(tmp_path):
    out = run("update.py", tmp_path, "seconds=0.1", "turns=1", "compiled=false", "transitions=1000", "threads=1")
    result = json.loads((tmp_path / "update.json").read_text())
    assert result["flop"] / 1e9 == pytest.approx(1.21, rel=0.05)  # with the authors' sizes, HalfCheetah
    assert result["limit"] == result["gflop_per_second"] * 1e9 / result["flop"]
    assert {"textbook", "ours, not compiled", "ours, neither", "SAC, TorchRL's loss", "SAC of our parts"} == set(
        result["updates_per_second"]
    )
    assert 0.0 < result["updates_per_second"]["ours, not compiled"] < result["limit"]
    assert "of the limit" in out


def test_a_folder_without_the_authors_code_is_said(tmp_path):
    command = [
        sys.executable,
        BENCHMARKS / "update.py",
        f"hydra.run.dir={tmp_path}",
        f"authors={tmp_path}",
        "transitions=300",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "clone t6-thu/H2Oplus" in done.stderr


def test_steps_are_set_beside_bare_rollouts(tmp_path):
    out = run("simulator.py", tmp_path, "seconds=0.1", "turns=1", "worlds=[1,16]")
    rates = json.loads((tmp_path / "simulator.json").read_text())["steps_per_second"]
    assert rates["BatchedMujocoEnv, 16"] > rates["BatchedMujocoEnv, 1"]
    assert rates["mujoco.rollout, 16"] > rates["BatchedMujocoEnv, 16"]
    assert "of mujoco.rollout" in out


def test_a_population_s_updates_are_set_beside_a_single_run_s(tmp_path):
    small = ("members=[1,3]", "compiled=[]", "seconds=0.1", "turns=1", "calls=1", "transitions=600", "threads=1")
    out = run("population.py", tmp_path, *small)
    result = json.loads((tmp_path / "population.json").read_text())
    assert [(line["members"], line["way"]) for line in result["lines"]] == [
        (1, "a single run"),
        (1, "stacked"),
        (3, "stacked"),
    ]
    for line in result["lines"]:
        assert line["run_updates_per_second"] == pytest.approx(line["members"] * line["updates_per_second"])
    best = max(line["run_updates_per_second"] for line in result["lines"])
    assert result["table"]["hours"] == pytest.approx(125e6 / best / 3600)
    assert "CPU" in result["device"]
    assert "25 tasks x 5 seeds x 1,000,000 updates" in out


def test_a_factor_pays_until_the_first_size_that_raises_the_rate_by_less_than_a_tenth():
    worlds = [Rate("worlds", size, per_second) for size, per_second in ((1, 100), (4, 300), (16, 320), (64, 900))]
    workers = [Rate("workers", 1, 50)]
    populations = [Rate("population", size, float(size)) for size in (8, 1, 2)]
    assert pays_until([*worlds, *workers, *populations]) == {"worlds": 4}


def test_costs_are_told_for_all_that_grows_and_mapped_buffers_leave_nothing(tmp_path):
    (tmp_path / "scratch").mkdir()
    small = ["transitions=1000", "buffer_sizes=[500,20000,1000000000000]", "batch_sizes=[8,16]", "widths=[8,512]"]
    small += ["populations=[1,4]", "worlds=[1,16]", "workers=[1]"]
    out = run("scaling.py", tmp_path, "seconds=0.01", "turns=1", "threads=1", f"scratch={tmp_path / 'scratch'}", *small)
    costs = json.loads((tmp_path / "scaling.json").read_text())["costs"]
    buffers = [(cost["size"], cost["storage"]) for cost in costs if cost["grows"] == "buffer"]
    assert buffers == [(size, where) for size in (500, 20_000) for where in ("in memory", "memory-mapped")]
    others = [(cost["grows"], cost["size"]) for cost in costs if cost["grows"] != "buffer"]
    assert others == [("batch", 8), ("batch", 16), ("width", 8), ("width", 512), ("population", 1), ("population", 4)]
    assert all(0.0 < cost["seconds_per_sample"] < cost["seconds_per_update"] for cost in costs)
    narrow, wide = (cost["memory"] for cost in costs if cost["grows"] == "width")
    # gradients and Adam's two moments of five networks with 0.28 million weights each, in bytes
    assert wide > narrow + 10_000_000
    alone, stacked = (cost for cost in costs if cost["grows"] == "population")
    # gradients, moments and activations of three more members, in bytes
    assert stacked["memory"] > alone["memory"] + 10_000_000
    assert stacked["seconds_per_update"] > alone["seconds_per_update"]
    assert "ms a sample" in out
    result = json.loads((tmp_path / "scaling.json").read_text())
    rates = {(rate["grows"], rate["size"]): rate["per_second"] for rate in result["growth"]}
    assert rates["worlds", 16] > rates["worlds", 1]
    assert rates["population", 4] == pytest.approx(4 / stacked["seconds_per_update"])
    assert "worlds: 16, the most measured, pay" in out
    assert "workers" not in result["pays_until"]
    assert (tmp_path / "growth.png").stat().st_size > 10_000
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    assert not list((tmp_path / "scratch").iterdir())
