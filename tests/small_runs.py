"""Runs that take seconds: their settings, and functions that start, read and interrupt them."""

import csv
import subprocess
from pathlib import Path

import pytest
import torch

from torchrl_h2o.training.checkpoint import checkpoint_file, read_checkpoint
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.progress import Training

ROOT = Path(__file__).parents[1]
SMALL = [
    "updates=60",
    "updates_per_epoch=20",
    "steps_per_epoch=40",
    "n_steps=3",
    "ratio_estimator=paper",
    "eval_every=1",
    "checkpoint_every=1",
    "eval_episodes=1",
    "trial_episodes=1",
    "final_episodes=1",
    "num_cells=[8,8]",
    "batch_size=[8,8]",
    "discriminator_batch_size=[8,8]",
    "render=false",
    "threads=1",
    "overlap=false",  # this and what follows are the defaults of train.py
    "mend=false",
    "warm_start=false",
    "keep=last",
]
ROBOT = ["env.make.max_episode_steps=40", "env.recording.num_transitions=200"]


def run(options):
    done = subprocess.run(**options, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return done.stdout


def trained(directory, method="h2o+"):
    """Reads the components of a method's checkpoint: the bytes of tensors, and other values, by their places."""

    def flat(place, value):
        if isinstance(value, torch.Tensor):
            return {place: (value.dtype, tuple(value.shape), value.numpy().tobytes())}
        if isinstance(value, dict | list | tuple):
            entries = value.items() if isinstance(value, dict) else enumerate(value)
            return {key: leaf for name, one in entries for key, leaf in flat(f"{place}.{name}", one).items()}
        return {place: value}

    return flat("", read_checkpoint(checkpoint_file(directory, method))["components"])


def rows(directory):
    with open(directory / "metrics.csv") as file:
        return list(csv.DictReader(file))


def interrupt_at(epoch, evaluate):
    def interrupted(self, evaluator, policy, current, **metrics):
        if current == epoch:
            raise KeyboardInterrupt
        evaluate(self, evaluator, policy, current, **metrics)

    return interrupted


def assert_resumed_equals_whole(method, cfg, real, directory, monkeypatch):
    """Trains in one go and with an interruption, compares the checkpoints; returns policy and training in one go."""
    policy, training = train(method, cfg, real, directory / "whole")
    monkeypatch.setattr(Training, "evaluate", interrupt_at(epoch=1, evaluate=Training.evaluate))
    with pytest.raises(KeyboardInterrupt):
        train(method, cfg, real, directory / "parts")
    monkeypatch.undo()
    train(method, cfg, real, directory / "parts")
    assert trained(directory / "parts", method.title) == trained(directory / "whole", method.title)
    return policy, training
