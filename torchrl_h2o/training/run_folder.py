"""The folder of a run: its configuration and its lock."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf
from tqdm import tqdm

from torchrl_h2o.options.types import why_unavailable
from torchrl_h2o.training.checkpoint import require_widths
from torchrl_h2o.training.config_file import load_config, require_plain_files, save_config
from torchrl_h2o.training.interrupts import interruptible
from torchrl_h2o.training.mending import names_report, prepare_mending
from torchrl_h2o.training.targets import foreign_names
from torchrl_h2o.training.warm_start import names_run, prepare_warm_start
from torchrl_h2o.whole_file import remove_partial

CHANGEABLE = ("overlap", "device")  # options that may change when a run is resumed


def open_run(cfg: DictConfig, *, go_on: bool = False) -> tuple[DictConfig, Path]:
    """Opens the folder of a new run, or of the run given by ``resume``.

    Args:
        cfg: configuration from the command line. A resumed run uses the configuration in its folder instead, in which
            it allows the names that ``trust`` lists, see :mod:`torchrl_h2o.training.targets`. ``overlap`` may change,
            because results do not depend on it, and ``device``, because the run may have been moved.
        go_on: whether to continue a run that exists in the folder, as with ``resume``.

    Returns:
        The run's configuration and its folder.

    Raises:
        ValueError: for other overrides together with ``resume``, and for a device that this machine does not have.
        FileNotFoundError: if the folder given by ``resume`` is not the folder of a run.
        FileExistsError: if the folder of a new run already contains a run.
        PermissionError: if the folder cannot be written to.
        torchrl_h2o.data.DataError: if the configuration in the folder cannot be read, or names what must not be built,
            or a checkpoint is damaged or has other networks.
    """
    directory = Path(HydraConfig.get().runtime.output_dir)
    if not os.access(directory, os.W_OK):
        raise PermissionError(f"the run's folder {directory} cannot be written to: copy it, or change its permissions")
    if not OmegaConf.is_missing(cfg, "resume"):
        overrides = HydraConfig.get().overrides.task
        others = [o for o in overrides if o.partition("=")[0] not in ("resume", "trust", "results", *CHANGEABLE)]
        if others:
            raise ValueError(f"a resumed run keeps its configuration: leave out {' '.join(others)}, or start a new run")
        if not any(directory.iterdir()):
            directory.rmdir()  # Hydra has made it; a mistyped name shall not leave a folder
        typed, cfg = cfg, load_config(directory, trust=cfg.get("trust"), typed=cfg)
        for option in CHANGEABLE:
            if any(o.startswith(f"{option}=") for o in overrides):
                cfg[option] = typed[option]
                _note_override(cfg, f"{option}={typed[option]}")
        _name_results(cfg, typed.get("results"))
    elif (directory / "config.yaml").exists():
        if not go_on:
            raise FileExistsError(f"{directory} holds a run already: resume={directory} goes on with it")
        cfg = load_config(directory, trust=cfg.get("trust"), typed=cfg)
    else:
        prepare_mending(cfg)
        prepare_warm_start(cfg)
        resolve_paths(cfg)
        save_config(cfg, directory)
    for checkpoint in sorted((directory / "checkpoints").glob("*.pt")):
        require_widths(cfg, checkpoint)
    if problem := why_unavailable(cfg.get("device", "cpu")):
        raise ValueError(f"device={cfg.device}: {problem}")
    torch.set_num_threads(cfg.threads)
    tqdm.write(f"run folder: {os.path.relpath(directory)}")
    return cfg, directory


def _note_override(cfg: DictConfig, override: str) -> None:
    """Replaces an override among those that the results file shows."""
    if cfg.get("overrides") is not None:
        option = override.partition("=")[0]
        cfg.overrides = [*(o for o in cfg.overrides if not o.startswith(f"{option}=")), override]


def _name_results(cfg: DictConfig, results: str | None) -> None:
    """Takes the file of results from this call, because a folder from somebody else could name any file to write to."""
    if results is None and cfg.get("results") is not None:
        tqdm.write(f"the results are not added to {cfg.results}; for that, add results={cfg.results} to the command")
    if "results" in cfg:
        cfg.results = results


def resolve_paths(cfg: DictConfig) -> None:
    """Makes file names absolute, in place, because a run may be resumed from another working directory."""
    named = {"mend": names_report(cfg.mend), "warm_start": names_run(cfg.warm_start)}
    for key in ("data", "columns", *(name for name, is_path in named.items() if is_path)):
        if isinstance(cfg[key], ListConfig):
            cfg[key] = [_absolute(name) for name in cfg[key]]
        elif cfg[key] is not None:
            cfg[key] = _absolute(cfg[key])


def _absolute(name: str) -> str:
    """The absolute name of a file, a folder or a glob with matches; any other name, such as a data set's, as is."""
    path = Path(name)
    is_glob = not path.exists() and not path.is_absolute() and any(glob.iglob(name, recursive=True))
    return str(path.resolve()) if path.exists() else str(Path.cwd() / path) if is_glob else name


@contextmanager
def claimed(directory: Path) -> Iterator[None]:
    """Locks a run's folder against other processes, and removes the unfinished files of a killed one.

    The lock is also released if the process is killed.

    Raises:
        RuntimeError: if another process has locked it.
        torchrl_h2o.data.DataError: if the folder contains a link, through which the run would write elsewhere.
    """
    require_plain_files(directory)
    try:
        with FileLock(directory / "run.lock", blocking=False):
            remove_partial(directory)
            yield
    except Timeout:
        raise RuntimeError(
            f"another process is at work in {os.path.relpath(directory)}: wait for it, or end it"
        ) from None


@contextmanager
def resumable(directory: Path) -> Iterator[None]:
    """Handles Ctrl-C: exits with the command that continues the run."""
    try:
        with interruptible():
            yield
    except KeyboardInterrupt:
        names = foreign_names(load_config(directory, trust=True)) if (directory / "config.yaml").exists() else []
        trust = f" 'trust=[{','.join(names)}]'" if names else ""
        sys.exit(f"\ninterrupted; go on with: python {sys.argv[0]} resume={os.path.relpath(directory)}{trust}")
