"""The main job as a command: its files, and its resumption after an interruption."""

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointRotation

from tests.small_runs import ROBOT, ROOT, SMALL, interrupt_at, rows, run, trained
from torchrl_h2o.data import write_ted
from torchrl_h2o.training.environments import make_simulator
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods.h2o_plus import H2O_PLUS
from torchrl_h2o.training.methods.sac import SAC
from torchrl_h2o.training.progress import Training
from torchrl_h2o.training.returns import evaluate
from torchrl_h2o.training.trained_policy import load_policy

DATA = Path(os.environ.get("TORCHRL_H2O_TEST_DATA", ROOT.parent / "shared" / "data"))


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("interruption", [signal.SIGKILL, signal.SIGINT])
def test_a_resumed_run_reaches_what_an_unbroken_one_reaches(command, tmp_path, interruption):
    small = [*SMALL, *ROBOT, "updates=100"]
    run(command(*small, "hydra.run.dir=unbroken"))

    broken = tmp_path / "broken"
    rotation = CheckpointRotation(broken / "checkpoints" / "h2o+", keep_last=1)
    process = subprocess.Popen(**command(*small, "hydra.run.dir=broken"), text=True)
    while rotation.latest() is None:
        assert process.poll() is None, process.communicate()[0]
    process.send_signal(interruption)
    printed, _ = process.communicate()
    assert process.returncode != 0
    assert not (broken / "summary.json").exists()
    if interruption == signal.SIGINT:
        assert "resume=broken" in printed

    run(command("resume=broken"))
    assert trained(broken) == trained(tmp_path / "unbroken")
    assert rows(broken) == rows(tmp_path / "unbroken")


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
        (["backbone=huber"], "choose expectile, sparse or exponential"),
        (["gap_strength=2"], "belongs to a gap"),
        (["env=halfcheetah", "data=recorded"], "name a data set"),
        (["keep=best"], "choose last or best_in_simulator"),
        (["compiled=maybe"], "choose auto, true or false"),
        (["resume=nowhere"], "not the folder of a run"),
    ],
)
def test_what_cannot_be_is_said_with_what_to_do(command, overrides, said):
    done = subprocess.run(**command(*overrides), text=True, check=False)
    assert done.returncode != 0
    assert said in done.stdout


def test_recorded_data_can_be_named_by_their_folder(compose, tmp_path):
    cfg, real = compose()
    again, same = compose(f"data={write_ted(real, tmp_path / 'recording')}")
    assert (same == real).all()
    assert again.observation_norm == cfg.observation_norm


@pytest.mark.slow
def test_backbone_mixing_and_ratio_reach_the_losses(compose, tmp_path):
    chosen = [(), ("backbone=sparse",), ("backbone=exponential",), ("mixing=0.9",), ("ratio=false",), ("gamma=0.5",)]
    losses = []
    for number, overrides in enumerate(chosen):
        cfg, real = compose("updates=20", *overrides)
        _, training = train(H2O_PLUS, cfg, real, tmp_path / str(number))
        losses.append((training.rows[-1]["loss_qvalue"], training.rows[-1]["loss_value"]))
    assert len(set(losses)) == len(chosen)


@pytest.mark.slow
@pytest.mark.parametrize("method", [H2O_PLUS, SAC])
def test_training_on_from_a_checkpoint_is_training_in_one_go(compose, tmp_path, method, monkeypatch):
    cfg, real = compose("updates=60", "lr_end_factor=0.1")
    train(method, cfg, real, tmp_path / "whole")
    monkeypatch.setattr("torchrl_h2o.training.progress.Training.log", interrupt_at(epoch=1, log=Training.log))
    with pytest.raises(KeyboardInterrupt):
        train(method, cfg, real, tmp_path / "parts")
    monkeypatch.undo()
    train(method, cfg, real, tmp_path / "parts")
    (name,) = [path.name for path in (tmp_path / "whole" / "checkpoints").iterdir()]
    assert trained(tmp_path / "parts", name) == trained(tmp_path / "whole", name)


@pytest.mark.slow
def test_the_policy_that_was_best_in_the_simulator_is_handed_over(compose, tmp_path, monkeypatch):
    cfg, real = compose("updates=100", "keep=best_in_simulator", "lr=0.01", "seed=1")
    policy, training = train(H2O_PLUS, cfg, real, tmp_path / "whole")
    promised = [row["return_sim"] for row in training.rows]
    assert max(promised) > promised[-1]
    assert evaluate(make_simulator(cfg, 1), policy, 1).mean == max(promised)
    assert evaluate(make_simulator(cfg, 1), load_policy(cfg, tmp_path / "whole"), 1).mean == max(promised)

    monkeypatch.setattr(
        "torchrl_h2o.training.progress.Training.log",
        interrupt_at(epoch=promised.index(max(promised)) + 1, log=Training.log),
    )
    with pytest.raises(KeyboardInterrupt):
        train(H2O_PLUS, cfg, real, tmp_path / "parts")
    monkeypatch.undo()
    train(H2O_PLUS, cfg, real, tmp_path / "parts")
    assert trained(tmp_path / "parts") == trained(tmp_path / "whole")


@pytest.mark.slow
def test_ctrl_c_waits_until_the_checkpoint_is_written(compose, tmp_path, monkeypatch):
    cfg, real = compose("updates=60")
    save = CheckpointRotation.save

    def interrupted(self, *args, **kwargs):
        signal.raise_signal(signal.SIGINT)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(CheckpointRotation, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(SAC, cfg, real, tmp_path)
    latest = CheckpointRotation(tmp_path / "checkpoints" / "sac_in_the_simulator", keep_last=1).latest()
    assert Checkpoint.manifest(latest)["metadata"]["progress"]["epoch"] == 1


@pytest.mark.slow
def test_a_damaged_checkpoint_is_an_error(compose, tmp_path):
    cfg, real = compose("updates=20")
    train(SAC, cfg, real, tmp_path)
    (archive,) = (tmp_path / "checkpoints" / "sac_in_the_simulator").glob("checkpoint*")
    archive.write_bytes(archive.read_bytes()[:-2000])
    with pytest.raises(RuntimeError, match="no checkpoint that can be read"):
        train(SAC, cfg, real, tmp_path)


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
