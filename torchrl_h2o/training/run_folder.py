"""What the recipes share around their training loops: a run's folder, its metrics, checkpoints and progress bar.

Every epoch has a random stream of its own, drawn from the run's seed and the epoch's number, and starts with fresh
simulator episodes. So a run that goes on from a checkpoint draws what an unbroken one draws.
"""

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from tqdm import tqdm

PACKAGES = ("torchrl_h2o", "torch", "torchrl", "tensordict", "gymnasium", "mujoco")

KEEP = ("last", "best_in_simulator")


def open_run(cfg: DictConfig, *, go_on: bool = False) -> tuple[DictConfig, Path]:
    """The configuration and folder of a new run, or of the one that ``resume`` names, whose own configuration counts.

    Args:
        cfg: what the command line asks for.
        go_on: with the run that is in the folder already, if there is one, as if ``resume`` named it.

    Raises:
        ValueError: for other overrides beside ``resume``, or settings that contradict each other.
        FileNotFoundError: if ``resume`` names a folder that is not a run's.
        FileExistsError: if a new run is to go where a run is already.
    """
    directory = Path(HydraConfig.get().runtime.output_dir)
    if not OmegaConf.is_missing(cfg, "resume"):
        others = [o for o in HydraConfig.get().overrides.task if not o.startswith("resume=")]
        if others:
            raise ValueError(f"a resumed run keeps its configuration: leave out {' '.join(others)}, or start a new run")
        cfg = load_config(directory)
    elif (directory / "config.yaml").exists():
        if go_on:
            return _opened(load_config(directory), directory)
        raise FileExistsError(f"{directory} holds a run already: resume={directory} goes on with it")
    if cfg.updates < 1:
        raise ValueError(f"updates={cfg.updates}: train for at least one")
    if cfg.get("keep", "last") not in KEEP:
        raise ValueError(f"keep={cfg.keep}: choose {' or '.join(KEEP)}")
    if cfg.get("compiled") not in (None, "auto", True, False):
        raise ValueError(f"compiled={cfg.compiled}: choose auto, true or false")
    if cfg.gap is None and cfg.get("gaps") is None and cfg.gap_strength is not None:
        raise ValueError(f"gap_strength={cfg.gap_strength} belongs to a gap: name one, such as gap=gravity")
    resolve_paths(cfg)
    save_config(cfg, directory)
    return _opened(cfg, directory)


def resolve_paths(cfg: DictConfig) -> None:
    """Makes what names files absolute, in place: a resumed run may start elsewhere."""
    for key in ("data", "columns", "gap_fix"):
        if cfg[key] is not None and Path(cfg[key]).exists():
            cfg[key] = str(Path(cfg[key]).resolve())


@contextmanager
def claimed(directory: Path) -> Iterator[None]:
    """Keeps other processes out of a run's folder; one that ends, however it does, leaves it free.

    Raises:
        RuntimeError: if another process is at work in it.
    """
    try:
        with FileLock(directory / "run.lock", blocking=False):
            yield
    except Timeout:
        raise RuntimeError(
            f"another process is at work in {os.path.relpath(directory)}: wait for it, or end it"
        ) from None


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A Ctrl-C inside takes effect at the end: one that breaks off file operations can come out as an OSError."""
    if threading.current_thread() is not threading.main_thread():  # which alone is interrupted
        yield
        return
    came = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


def _opened(cfg: DictConfig, directory: Path) -> tuple[DictConfig, Path]:
    torch.set_num_threads(cfg.threads)
    tqdm.write(f"run folder: {os.path.relpath(directory)}")
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
        self.name, self.cfg, self.directory = name, cfg, directory
        self.progress = {"epoch": 0, "seconds": 0.0, "update_seconds": 0.0, "rows": []}
        self.checkpoint = Checkpoint(format="archive", **components)  # a ZIP: a damaged one is an error, not zeros
        directory.mkdir(parents=True, exist_ok=True)
        folder = checkpoint_folder(directory, name)
        self.rotation = CheckpointRotation(folder, keep_last=1)
        if (latest := self.rotation.latest()) is not None:
            self.checkpoint.load(latest)
            self.progress = Checkpoint.manifest(latest)["metadata"]["progress"]
        elif folder.exists() and any(not path.name.startswith(".") for path in folder.iterdir()):
            raise RuntimeError(
                f"{folder} holds no checkpoint that can be read: remove it to train {name} from the start"
            )

    @property
    def updates(self) -> int:
        """How many updates the epochs come to."""
        return num_epochs(self.cfg) * self.cfg.updates_per_epoch

    @property
    def rows(self) -> list[dict]:
        """The metrics so far, one row an evaluation."""
        return self.progress["rows"]

    def epochs(self) -> Iterator[tuple[int, bool]]:
        """Yields each epoch's number and whether to evaluate at its end; checkpoints after it."""
        done = self.progress["epoch"]
        self._bar = tqdm(desc=self.name, total=self.updates, initial=done * self.cfg.updates_per_epoch, unit=" updates")
        for epoch in range(done, num_epochs(self.cfg)):
            start = time.perf_counter()
            last = epoch + 1 == num_epochs(self.cfg)
            yield epoch, last or (epoch + 1) % self.cfg.eval_every == 0
            self.progress["epoch"] = epoch + 1
            self.progress["seconds"] += time.perf_counter() - start
            if last or (epoch + 1) % self.cfg.checkpoint_every == 0:
                with uninterrupted():
                    self.rotation.save(self.checkpoint, step=epoch + 1, metadata={"progress": self.progress})
        self._bar.close()

    def epoch_updates(self) -> Iterator[int]:
        """Counts the updates of an epoch, on the bar and in time."""
        start = time.perf_counter()
        for update in range(self.cfg.updates_per_epoch):
            yield update
            self._bar.update()
        self.progress["update_seconds"] += time.perf_counter() - start

    @property
    def updates_per_second(self) -> float:
        """Updates alone, without collection and evaluation."""
        return self.progress["epoch"] * self.cfg.updates_per_epoch / self.progress["update_seconds"]

    def log(self, epoch: int, **metrics: float) -> None:
        """Adds a row of metrics, writes metrics.csv, and shows the return in reality beside the bar."""
        self.rows.append(self._row(epoch, metrics))
        write_metrics(self.directory, self.name, self.rows)
        self._bar.set_postfix(return_real=f"{metrics['return_real']:.0f}")

    def _row(self, epoch: int, metrics: dict[str, float]) -> dict:
        return {"method": self.name, "updates": (epoch + 1) * self.cfg.updates_per_epoch, **metrics}


def keeps_best(cfg: DictConfig) -> bool:
    """Whether the policy that did best in the simulator is handed over, and not the last."""
    return cfg.get("keep", "last") == "best_in_simulator"  # a run of an earlier version says nothing of it


def num_epochs(cfg: DictConfig) -> int:
    """The budget of updates, rounded up to whole epochs."""
    return -(-cfg.updates // cfg.updates_per_epoch)


def checkpoint_folder(directory: Path, name: str) -> Path:
    return Path(directory) / "checkpoints" / name.lower().replace(" ", "_")


def write_metrics(directory: Path, method: str, rows: list[dict]) -> None:
    """metrics.csv: a row an evaluation, a column a metric; the rows of other methods stay."""
    path = directory / "metrics.csv"
    if path.exists():
        with open(path, newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["method"] != method] + rows
    first = ["method", "updates", "return_real", "return_real_std", "length_real"]
    others = {key for row in rows for key in row} - set(first)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, [*first, *sorted(others)])
        writer.writeheader()
        writer.writerows(rows)


def write_summary(directory: Path, summary: dict) -> None:
    """summary.json, with the versions and the command that made it."""
    summary = summary | {
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}, **_commit()},
        "command": shlex.join(["python", *sys.argv]),
    }
    (directory / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")


def _commit() -> dict[str, str]:
    """The commit of the recipes, where they are in a repository; results that runs append to do not make it dirty."""
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return {}
    unchanged = [*git, "diff", "--quiet", "HEAD", "--", ":/", ":(exclude,top)recipes/results"]
    dirty = "-dirty" * (subprocess.run(unchanged, check=False).returncode != 0)
    return {"commit": commit.stdout.strip() + dirty}
