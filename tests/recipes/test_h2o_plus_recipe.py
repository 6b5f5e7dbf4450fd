"""The main job as its user runs it: a command line in, files out, and going on after an interruption."""

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import CheckpointRotation

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("TORCHRL_H2O_TEST_DATA", ROOT.parent / "shared" / "data"))
SMALL = [
    "updates=60",
    "updates_per_epoch=20",
    "steps_per_epoch=40",
    "eval_every=1",
    "eval_episodes=1",
    "final_episodes=1",
    "num_cells=[8,8]",
    "batch_size=[8,8]",
    "discriminator_batch_size=[8,8]",
    "render=false",
    "threads=1",
]
ROBOT = ["env.make.max_episode_steps=40", "env.recording.num_transitions=200"]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def command(cache, tmp_path):
    def build(*overrides, script="h2o_plus.py"):
        env = os.environ | {"XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}
        arguments = [sys.executable, str(ROOT / "recipes" / script), *overrides]
        return {"args": arguments, "env": env, "cwd": tmp_path, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}

    return build


def run(options):
    done = subprocess.run(**options, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return done.stdout


def latest_tensors(directory, method="h2o+"):
    latest = CheckpointRotation(directory / "checkpoints" / method, keep_last=1).latest()
    assert latest is not None
    return {
        str(path.relative_to(latest)): path.read_bytes()
        for path in sorted(latest.rglob("*"))
        if path.is_file() and path.suffix in (".memmap", ".pt", ".safetensors")
    }


def rows(directory):
    with open(directory / "metrics.csv") as file:
        return list(csv.DictReader(file))


def test_one_command_leaves_everything_that_a_user_looks_at(command, tmp_path):
    printed = run(command(*SMALL, *ROBOT, "hydra.run.dir=out"))
    out = tmp_path / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["updates"] == 60
    assert summary["env"] == "wheel_legged"
    assert summary["return_real"].keys() >= {"mean", "std", "episodes"}
    assert {
        "gap",
        "data",
        "backbone",
        "mixing",
        "seed",
        "return_sim",
        "updates_per_second",
        "wall_s",
        "versions",
    } <= set(summary)
    assert {row["method"] for row in rows(out)} == {"H2O+", "SAC in the simulator"}
    assert (out / "learning_curve.png").stat().st_size > 10_000
    assert "warn" not in printed.lower()
    for name in ("H2O+", "SAC in the simulator", "the data's behaviour"):
        assert name in printed

    replayed = run(command("checkpoint=out", "episodes=1", "film=null", script="evaluate.py"))
    assert "H2O+ in reality" in replayed
    evaluation = json.loads((out / "evaluation.json").read_text())
    assert evaluation["episodes"] == 1


@pytest.mark.parametrize("interruption", [signal.SIGKILL, signal.SIGINT])
def test_a_resumed_run_reaches_what_an_unbroken_one_reaches(command, tmp_path, interruption):
    small = [*SMALL, *ROBOT, "baseline=false", "updates=100"]
    run(command(*small, "hydra.run.dir=unbroken"))

    broken = tmp_path / "broken"
    rotation = CheckpointRotation(broken / "checkpoints" / "h2o+", keep_last=1)
    process = subprocess.Popen(**command(*small, "hydra.run.dir=broken"))
    while rotation.latest() is None:
        assert process.poll() is None, process.communicate()[0]
    process.send_signal(interruption)
    process.communicate()
    assert process.returncode != 0
    assert not (broken / "summary.json").exists()

    run(command("resume=broken"))
    ours, theirs = latest_tensors(broken), latest_tensors(tmp_path / "unbroken")
    assert ours.keys() == theirs.keys()
    assert ours == theirs
    assert rows(broken) == rows(tmp_path / "unbroken")


def test_resume_of_something_else_says_so(command, tmp_path):
    (tmp_path / "empty").mkdir()
    done = subprocess.run(**command("resume=empty"), text=True, check=False)
    assert done.returncode != 0
    assert "not the folder of a run" in done.stdout


def test_backbone_mixing_and_ratio_are_overrides(command, tmp_path):
    for backbone in ("sparse", "exponential"):
        chosen = [f"backbone={backbone}", "mixing=0.5", "ratio=false", "baseline=false", "updates=20"]
        run(command(*SMALL, *ROBOT, *chosen, "hydra.run.dir=" + backbone))
        summary = json.loads((tmp_path / backbone / "summary.json").read_text())
        assert (summary["backbone"], summary["mixing"], summary["ratio"]) == (backbone, 0.5, False)


needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the measured data are not there: {DATA}")


@needs_data
def test_the_real_robot_s_log_is_an_override(command, tmp_path):
    log = DATA / "wheel_legged" / "standing_still.txt"
    run(command(*SMALL, *ROBOT, f"data={log}", "baseline=false", "updates=20", "hydra.run.dir=out"))
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["transitions"] > 16_000


@needs_data
def test_a_minari_dataset_and_a_gap_are_overrides(command, tmp_path):
    data = DATA / "minari" / "walker2d" / "medium-replay-v0"
    chosen = ["env=walker2d", "gap=gravity", f"data={data}", "baseline=false", "updates=20", "hydra.run.dir=out"]
    run(command(*SMALL, *chosen))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["gap"] == "gravity"
    assert summary["transitions"] == 250_001
    assert torch.isfinite(torch.tensor(summary["return_real"]["mean"]))
