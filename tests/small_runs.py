"""Runs that take seconds: their settings, and functions that start, read and interrupt them."""

import csv
import subprocess
import zipfile
from pathlib import Path

from torchrl.checkpoint import CheckpointRotation

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
    "final_episodes=1",
    "num_cells=[8,8]",
    "batch_size=[8,8]",
    "discriminator_batch_size=[8,8]",
    "render=false",
    "threads=1",
]
ROBOT = ["env.make.max_episode_steps=40", "env.recording.num_transitions=200"]


def run(options):
    done = subprocess.run(**options, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return done.stdout


def trained(directory, method="h2o+"):
    """Reads the last checkpoint: the bytes of its components, by file name."""
    latest = CheckpointRotation(directory / "checkpoints" / method, keep_last=1).latest()
    with zipfile.ZipFile(latest) as archive:
        return {name: archive.read(name) for name in archive.namelist() if name.startswith("components")}


def rows(directory):
    with open(directory / "metrics.csv") as file:
        return list(csv.DictReader(file))


def interrupt_at(epoch, log):
    def interrupted(self, current, **metrics):
        if current == epoch:
            raise KeyboardInterrupt
        log(self, current, **metrics)

    return interrupted
