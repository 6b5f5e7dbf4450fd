"""The main job as a command: its files, and its resumption after an interruption."""

import importlib
import json
import os
import signal
import subprocess
import zipfile
from pathlib import Path

import pytest
import torch

from tests.small_runs import ROBOT, ROOT, SMALL, rows, run, trained
from torchrl_h2o.training.checkpoint import checkpoint_file
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.progress import Training

DATA = Path(os.environ.get("TORCHRL_H2O_TEST_DATA", ROOT.parent / "shared" / "data"))


@pytest.mark.slow
def test_one_command_leaves_everything_that_a_user_looks_at(command, tmp_path):
    printed = run(command(*SMALL, *ROBOT, "hydra.run.dir=out"))
    out = tmp_path / "out"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["updates"] == 60
    assert summary["env"] == "wheel_legged"
    assert summary["return_real"].keys() >= {"mean", "std", "episodes"}
    told = {
        "gap",
        "data",
        "backbone",
        "mixing",
        "seed",
        "return_sim",
        "updates_per_second",
        "wall_s",
        "versions",
        "commit",
    }
    assert told <= set(summary)
    assert {row["method"] for row in rows(out)} == {"H2O+"}
    assert (out / "learning_curve.png").stat().st_size > 10_000
    assert "warn" not in printed.lower()
    for name in ("H2O+", "the data's behaviour"):
        assert name in printed

    replayed = run(command("checkpoint=out", "episodes=1", "film=null", script="evaluate.py"))
    assert "H2O+ in reality" in replayed
    evaluation = json.loads((out / "evaluation.json").read_text())
    assert evaluation["episodes"] == 1


@pytest.mark.slow
def test_a_baseline_is_trained_and_reported_beside_the_method(command, tmp_path):
    printed = run(command(*SMALL, *ROBOT, "baselines=[sac]", "hydra.run.dir=out", script="train.py"))
    assert {row["method"] for row in rows(tmp_path / "out")} == {"H2O+", "SAC in the simulator"}
    assert "SAC in the simulator" in printed
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["baselines"].keys() == {"SAC in the simulator"}


@pytest.mark.slow
def test_the_loop_of_the_recipe_reaches_the_numbers_of_the_loop_of_train(command, tmp_path):
    small = [*SMALL, *ROBOT, "keep=best_in_simulator", "warm_start=true"]
    run(command(*small, "hydra.run.dir=recipe"))
    run(command(*small, "hydra.run.dir=package", script="train.py"))
    assert trained(tmp_path / "recipe") == trained(tmp_path / "package")
    assert rows(tmp_path / "recipe") == rows(tmp_path / "package")


@pytest.mark.slow
def test_a_population_is_trained_by_its_lists_of_options(command, tmp_path):
    small = [*SMALL, *ROBOT, "seeds=[0,1]", "keep=best_in_simulator", "hydra.run.dir=out"]
    printed = run(command(*small, script="train.py"))
    trials = {name: json.loads((tmp_path / "out" / name / "summary.json").read_text())["return_trial"]
              for name in ("seed_0", "seed_1")}  # fmt: skip
    assert all(name in printed for name in trials)
    assert f"use        {max(trials, key=lambda name: trials[name])}, the best in the simulator" in printed


@pytest.mark.slow
def test_members_with_different_simulators_are_not_compared_in_them(command, tmp_path):
    small = [*SMALL, *ROBOT, "gaps=[null,gravity]", "keep=best_in_simulator", "hydra.run.dir=out"]
    assert "the best in the simulator" not in run(command(*small, script="train.py"))


@pytest.mark.slow
def test_a_population_of_another_method_is_refused(command):
    done = subprocess.run(**command("seeds=[0,1]", "method=sac", script="train.py"), text=True, check=False)
    assert done.returncode != 0
    assert "a population trains h2o_plus alone" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interruption", "options", "updates"),
    # long enough that the signal comes before the end; with overlap=true a checkpoint waits for the evaluation
    [(signal.SIGKILL, [], 300), (signal.SIGINT, [], 1000), (signal.SIGKILL, ["overlap=true"], 1000)],
)
def test_a_resumed_run_reaches_what_an_unbroken_one_reaches(command, tmp_path, interruption, options, updates):
    small = [*SMALL, *ROBOT, f"updates={updates}"]
    run(command(*small, "hydra.run.dir=unbroken"))

    broken = tmp_path / "broken"
    process = subprocess.Popen(**command(*small, *options, "hydra.run.dir=broken"), text=True)
    while not checkpoint_file(broken, "H2O+").exists():
        assert process.poll() is None, process.communicate()[0]
    process.send_signal(interruption)
    printed, _ = process.communicate()
    assert process.returncode != 0
    assert not (broken / "summary.json").exists()
    if interruption == signal.SIGINT:
        assert "resume=broken" in printed

    run(command("resume=broken", *(["overlap=false"] if options else [])))
    assert trained(broken) == trained(tmp_path / "unbroken")
    assert rows(broken) == rows(tmp_path / "unbroken")


@pytest.fixture
def failing(compose, tmp_path, monkeypatch):
    """Train by the recipe until its first update raises an error; return what it has ended by then."""
    recipe, ended = importlib.import_module("h2o_plus"), []

    def noting(make, method, name):
        def made(*args, **kwargs):
            part = make(*args, **kwargs)
            monkeypatch.setattr(part, method, lambda: ended.append(name))
            return part

        return made

    for maker, method in {"evaluator_of": "close", "simulated_transitions": "shutdown"}.items():
        monkeypatch.setattr(recipe, maker, noting(getattr(recipe, maker), method, maker))

    def train(error):
        def fails(training, losses):
            raise error

        monkeypatch.setattr(Training, "check", fails)
        with pytest.raises(type(error)):
            recipe.train(compose("keep=last", config="h2o_plus")[0], tmp_path)
        return sorted(ended)

    return train


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("of any kind"), DivergenceError("", "why", 0)])
def test_a_training_that_fails_ends_what_it_has_started(failing, error):
    assert failing(error) == ["evaluator_of", "simulated_transitions"]


def test_a_training_that_diverges_leaves_the_reason(failing, tmp_path):
    failing(DivergenceError("long message", "loss_qvalue is nan at update 4", 3))
    summary = json.loads((tmp_path / "summary.json").read_text())
    told = {"updates": 3, "return_real": None, "failure": "loss_qvalue is nan at update 4", "seed": 0}
    assert {key: summary[key] for key in told} == told


def test_a_training_that_fails_in_another_way_can_be_resumed_and_has_no_summary(failing, tmp_path):
    failing(RuntimeError("of any kind"))
    assert not (tmp_path / "summary.json").exists()


@pytest.mark.slow
def test_every_job_of_a_multirun_has_a_folder_and_a_seed_of_its_own(command, tmp_path):
    run(command("--multirun", *SMALL, *ROBOT, "updates=20", "seed=0,1"))
    summaries = [json.loads(path.read_text()) for path in tmp_path.glob("outputs/multirun/*/*/summary.json")]
    assert sorted(summary["seed"] for summary in summaries) == [0, 1]
    assert summaries[0]["return_real"] != summaries[1]["return_real"]


@pytest.mark.slow
def test_a_run_goes_into_a_new_folder_by_default_and_never_into_another_run_s(command, tmp_path):
    run(command(*SMALL, *ROBOT, "updates=20"))
    (summary,) = tmp_path.glob("outputs/wheel_legged/*/summary.json")
    again = subprocess.run(**command(*SMALL, f"hydra.run.dir={summary.parent}"), text=True, check=False)
    assert again.returncode != 0
    assert "holds a run already" in again.stdout
    other = subprocess.run(**command(f"resume={summary.parent}", "mixing=0.9"), text=True, check=False)
    assert other.returncode != 0
    assert "leave out mixing=0.9" in other.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["backbone=huber"], "must be expectile, sparse or exponential"),
        (["gap_strength=2"], "belongs to a gap"),
        (["n_steps=0"], "must be an integer of at least 1"),
        (["n_steps=500"], "less than the 200 steps of each world"),
        (["num_qvalue_nets=0"], "must be an integer from 1 to 10000"),
        (["env=halfcheetah", "data=recorded"], "name a data set"),
        (["keep=best"], "must be last or best_in_simulator"),
        (["compiled=maybe"], "must be auto, true or false"),
        (["resume=nowhere"], "not the folder of a run"),
    ],
)
def test_what_cannot_be_is_said_with_what_to_do(command, tmp_path, overrides, said):
    done = subprocess.run(**command(*overrides), text=True, check=False)
    assert done.returncode != 0
    assert said in done.stdout
    assert not (tmp_path / "nowhere").exists()


needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the measured data are not there: {DATA}")


@pytest.mark.slow
@needs_data
def test_the_real_robot_s_log_is_an_override(command, tmp_path):
    log = DATA / "wheel_legged" / "standing_still.txt"
    run(command(*SMALL, *ROBOT, f"data={log}", "updates=20", "hydra.run.dir=out"))
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["transitions"] > 16_000


@pytest.mark.slow
@needs_data
def test_data_of_another_task_are_refused(command):
    data = DATA / "minari" / "halfcheetah" / "medium-v0"
    done = subprocess.run(**command("env=walker2d", f"data={data}"), text=True, check=False)
    assert done.returncode != 0
    assert "recorded in HalfCheetah-v5, not in Walker2d-v5" in done.stdout


@pytest.mark.slow
@needs_data
def test_a_minari_dataset_and_a_gap_are_overrides(command, tmp_path):
    data = DATA / "minari" / "walker2d" / "medium-replay-v0"
    chosen = ["env=walker2d", "gap=gravity", f"data={data}", "updates=20", "hydra.run.dir=out"]
    run(command(*SMALL, *chosen))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["gap"] == "gravity"
    assert summary["transitions"] == 250_001
    assert torch.isfinite(torch.tensor(summary["return_real"]["mean"]))


def as_if_from_a_gpu(directory):
    """Rewrites a run's folder as if it had been trained on a GPU: its device, and the devices in its checkpoint."""
    config = directory / "config.yaml"
    config.write_text(config.read_text().replace("device: cpu", "device: cuda"))
    (checkpoint,) = directory.glob("checkpoints/*.pt")
    with zipfile.ZipFile(checkpoint) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(checkpoint, "w") as archive:  # texts are written with their lengths
        for name, data in held.items():
            archive.writestr(name, data.replace(b"X\x03\0\0\0cpu", b"X\x06\0\0\0cuda:0"))
    assert b"cuda:0" in checkpoint.read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_a_run_from_a_gpu_is_evaluated_and_resumed_on_a_machine_without_one(command, tmp_path):
    run(command(*SMALL, *ROBOT, "hydra.run.dir=moved", script="train.py"))
    as_if_from_a_gpu(tmp_path / "moved")
    config, shorter = tmp_path / "moved" / "config.yaml", rows(tmp_path / "moved")
    assert "in reality" in run(command("checkpoint=moved", "film=null", script="evaluate.py"))
    config.write_text(config.read_text().replace("updates: 60", "updates: 80"))
    (tmp_path / "moved" / "summary.json").unlink()  # a run with a summary is finished
    refused = subprocess.run(**command("resume=moved", script="train.py"), text=True, check=False)
    assert refused.returncode == 1
    assert "device=cuda: this machine has no CUDA device that torch can use; choose device=cpu" in refused.stdout
    run(command("resume=moved", "device=cpu", "results=results.csv", script="train.py"))
    assert rows(tmp_path / "moved")[: len(shorter)] == shorter
    assert rows(tmp_path / "moved")[-1]["updates"] == "80"
    assert "device=cpu" in (tmp_path / "results.csv").read_text()
    assert json.loads((tmp_path / "moved" / "summary.json").read_text())["device"] == "cpu"
