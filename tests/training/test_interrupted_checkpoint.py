"""Checkpoints that are not completed: on a full disk, and after a kill in the middle of writing one."""

import multiprocessing
import os
import signal

import pytest
import torch

from tests.data.recordings import make_recording
from tests.full_disk import fill, small_disk
from tests.small_runs import rows, trained
from torchrl_h2o.data import write_ted
from torchrl_h2o.training.checkpoint import checkpoint_file, load_checkpoint
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.progress import Budget, Training
from torchrl_h2o.training.run_folder import claimed

BUDGET = Budget(updates=3, updates_per_epoch=1)


def advance(folder, actor=None, before=lambda epoch: None):
    """Trains a network whose weight is the number of the epoch; calls ``before`` ahead of each checkpoint."""
    actor = torch.nn.Linear(300, 300, bias=False) if actor is None else actor
    training = Training("H2O+", folder, BUDGET, actor=actor, more=torch.nn.Linear(2, 2))
    start = training.progress["epoch"]
    for epoch, _ in training.epochs():
        actor.weight.data.fill_(epoch + 1)
        training.rows.append({"method": "H2O+", "epoch": epoch})
        before(epoch)
    return start


def hidden(folder):
    return sorted(path.name for path in folder.rglob(".*"))


def kill(*args, **kwargs):
    os.kill(os.getpid(), signal.SIGKILL)


KILLED_AT = {"while the file is written": (os, "fsync"), "before it is renamed": (os, "replace")}


@pytest.mark.parametrize("moment", KILLED_AT)
def test_nothing_of_a_killed_checkpoint_stays_and_the_training_goes_on(tmp_path, moment):
    owner, name = KILLED_AT[moment]

    def train_and_die():
        def before(epoch):
            if epoch == 1:
                setattr(owner, name, kill)

        advance(tmp_path, before=before)

    process = multiprocessing.get_context("fork").Process(target=train_and_die)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert hidden(tmp_path)
    with claimed(tmp_path):
        assert hidden(tmp_path) == []
        actor = torch.nn.Linear(300, 300, bias=False)
        assert advance(tmp_path, actor) == 1
    assert (actor.weight == 3).all()
    assert hidden(tmp_path) == []


@pytest.mark.parametrize("leave", [0, 100_000, 300_000])
def test_a_full_disk_at_a_later_checkpoint_leaves_the_earlier_one(tmp_path, leave):
    """One checkpoint takes 360 kB."""
    with small_disk(tmp_path / "disk") as disk:
        filler = None

        def before(epoch):
            nonlocal filler
            if epoch == 1:
                filler = fill(disk, leave)

        with pytest.raises(OSError, match="No space left"):
            advance(disk / "run", before=before)
        assert hidden(disk / "run") == []
        actor = torch.nn.Linear(300, 300, bias=False)
        load_checkpoint(checkpoint_file(disk / "run", "H2O+"), {"actor": actor})
        assert (actor.weight == 1).all()
        filler.unlink()
        assert advance(disk / "run", actor) == 1
        assert (actor.weight == 3).all()


def test_a_full_disk_refuses_a_recording_instead_of_ending_the_process(tmp_path):
    with small_disk(tmp_path / "disk", "64k") as disk:
        with pytest.raises(OSError, match="the disk has"):
            write_ted(make_recording((3000,), (True,)), disk / "recording")
        assert list(disk.iterdir()) == []


@pytest.mark.slow
def test_a_run_on_a_full_disk_reaches_the_same_numbers_once_there_is_room(compose, tmp_path, monkeypatch):
    cfg, real = compose()
    method, go_on = METHODS["h2o_plus"], Training.evaluate
    train(method, cfg, real, tmp_path / "whole")
    with small_disk(tmp_path / "disk", "16m") as disk:
        filler = None

        def full_at_the_second_evaluation(self, evaluator, policy, epoch, **metrics):
            nonlocal filler
            if epoch == 1:
                filler = fill(disk)
            go_on(self, evaluator, policy, epoch, **metrics)

        monkeypatch.setattr(Training, "evaluate", full_at_the_second_evaluation)
        with pytest.raises(OSError, match="No space left"):
            train(method, cfg, real, disk / "run")
        monkeypatch.undo()
        assert len(rows(disk / "run")) == 1
        assert hidden(disk / "run") == []
        filler.unlink()
        train(method, cfg, real, disk / "run")
        assert trained(disk / "run") == trained(tmp_path / "whole")
        assert rows(disk / "run") == rows(tmp_path / "whole")
