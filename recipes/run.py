"""What the recipes share around their training loops: a run's folder, its metrics, checkpoints and progress bar.

Every epoch has a random stream of its own, drawn from the run's seed and the epoch's number, and starts with fresh
simulator episodes. So a run that goes on from a checkpoint draws what an unbroken one draws.
"""

import csv
import json
import shlex
import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.envs import EnvBase
from tqdm import tqdm

PACKAGES = ("torchrl_h2o", "torch", "torchrl", "tensordict", "gymnasium", "mujoco")


def open_run(cfg: DictConfig, directory: str | Path) -> tuple[DictConfig, Path]:
    """The configuration and folder of a new run, or of the one that ``resume`` names, whose own configuration counts.

    Raises:
        FileNotFoundError: if ``resume`` names a folder that is not a run's.
    """
    directory = Path(directory)
    if cfg.resume is not None:
        cfg = load_config(directory)
    directory.mkdir(parents=True, exist_ok=True)
    save_config(cfg, directory)
    torch.set_num_threads(cfg.threads)
    return cfg, directory


def save_config(cfg: DictConfig, directory: Path) -> None:
    OmegaConf.save(cfg, directory / "config.yaml", resolve=True)


def load_config(directory: str | Path) -> DictConfig:
    """The configuration of a run.

    Raises:
        FileNotFoundError: if the folder is not a run's.
    """
    saved = Path(directory) / "config.yaml"
    if not saved.exists():
        raise FileNotFoundError(f"{directory} is not the folder of a run: it has no config.yaml")
    return OmegaConf.load(saved)


class Training:
    """One method's training inside a run: epochs, metrics and checkpoints.

    Args:
        name: what the bar and the tables call the method.
        cfg: the run's configuration.
        directory: the run's folder; checkpoints go to a folder of the method's own in it.
        **components: what a checkpoint holds (losses, optimisers, replay buffers).
    """

    def __init__(self, name: str, cfg: DictConfig, directory: Path, **components) -> None:
        self.name, self.cfg = name, cfg
        self.progress = {"epoch": 0, "seconds": 0.0, "rows": []}
        self.checkpoint = Checkpoint(**components)
        self.rotation = CheckpointRotation(checkpoint_folder(directory, name), keep_last=1)
        if (latest := self.rotation.latest()) is not None:
            self.checkpoint.load(latest)
            self.progress = Checkpoint.manifest(latest)["metadata"]["progress"]

    @property
    def num_epochs(self) -> int:
        return -(-self.cfg.updates // self.cfg.updates_per_epoch)

    @property
    def updates(self) -> int:
        """How many updates the epochs come to: the budget, rounded up to whole epochs."""
        return self.num_epochs * self.cfg.updates_per_epoch

    @property
    def rows(self) -> list[dict]:
        """The metrics so far, one row an evaluation."""
        return self.progress["rows"]

    def epochs(self, env: EnvBase) -> Iterator[tuple[int, bool]]:
        """Yields each epoch's number and whether to evaluate at its end; seeds it, counts time, and checkpoints."""
        done = self.progress["epoch"]
        self._bar = tqdm(desc=self.name, total=self.updates, initial=done * self.cfg.updates_per_epoch, unit=" updates")
        for epoch in range(done, self.num_epochs):
            start = time.perf_counter()
            seed = int(np.random.SeedSequence((self.cfg.seed, epoch)).generate_state(1)[0])
            torch.manual_seed(seed)
            env.set_seed(seed % 2**31)
            last = epoch + 1 == self.num_epochs
            yield epoch, last or (epoch + 1) % self.cfg.eval_every == 0
            self.progress["epoch"] = epoch + 1
            self.progress["seconds"] += time.perf_counter() - start
            if last or (epoch + 1) % self.cfg.checkpoint_every == 0:
                self.rotation.save(self.checkpoint, step=epoch + 1, metadata={"progress": self.progress})
        self._bar.close()

    def updated(self) -> None:
        """One update is done."""
        self._bar.update()

    def log(self, epoch: int, **metrics: float) -> None:
        """Adds a row of metrics and shows the returns beside the bar."""
        row = {"method": self.name, "updates": (epoch + 1) * self.cfg.updates_per_epoch, **metrics}
        self.rows.append(row)
        shown = {k: f"{v:.0f}" for k, v in metrics.items() if k in ("return_real", "return_sim")}
        self._bar.set_postfix(shown)


def checkpoint_folder(directory: Path, name: str) -> Path:
    return Path(directory) / "checkpoints" / name.lower().replace(" ", "_")


def write_metrics(directory: Path, rows: list[dict]) -> None:
    """metrics.csv: a row an evaluation, a column a metric, of all methods of a run."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with open(directory / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def write_summary(directory: Path, summary: dict) -> None:
    """summary.json, with the versions and the command that made it."""
    summary = summary | {
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}},
        "command": shlex.join(["python", *sys.argv]),
    }
    (directory / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
