"""Trains one run of a comparison and appends its row to the results file."""

import json
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchrl_h2o.comparison.results_file import append_run
from torchrl_h2o.options import TrainOptions, check_options
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.interrupts import interruptible
from torchrl_h2o.training.job import run_job
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.run_folder import claimed, open_run


def train_and_record(cfg: DictConfig, directory: Path) -> None:
    """Train one method and append its results. If the run is finished, only append its results.

    Args:
        cfg: the run's configuration; ``results`` is the CSV file, or None to append nothing.
        directory: the run's folder.

    Raises:
        DivergenceError: if the training diverges, or did so in an earlier attempt.
    """
    summary = directory / "summary.json"
    if summary.exists() and (failure := json.loads(summary.read_text()).get("failure")) is not None:
        # the same settings and seed give the same numbers, so a grid does not train it again
        message = f"{failure} in an earlier attempt, and the same settings repeat it; remove {directory} to try again"
        raise DivergenceError(message, failure, 0)
    if not summary.exists():
        run_job(cfg, directory, [METHODS[name] for name in (cfg.method, *(cfg.get("baselines") or ()))])
    if cfg.results is not None:
        append_run(Path(cfg.results), cfg, directory)


def train_grid_run(cfg: DictConfig) -> None:
    """Start or continue one run of a grid, called by a Hydra launcher.

    The function is part of the package because launchers import it by name in their worker processes.

    Args:
        cfg: the run's configuration, composed from paper.yaml.
    """
    cfg.overrides = list(HydraConfig.get().overrides.task)
    cfg.seeds = cfg.gaps = None  # in the grid they select runs; in a single run they would start a population
    check_options(cfg, TrainOptions, saved=True)  # as saved, because it also has the options of the grid
    results = cfg.results
    cfg, directory = open_run(cfg, go_on=True)
    cfg.results = results  # an interrupted run may have been started for another results file
    with claimed(directory), interruptible():  # otherwise the grid could go on with its next run after Ctrl-C
        train_and_record(cfg, directory)
