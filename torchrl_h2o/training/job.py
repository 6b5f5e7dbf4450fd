"""One job: trains methods on the same data, evaluates them in reality and writes the run's files."""

import time
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig
from tensordict import TensorDictBase
from tqdm import tqdm

from torchrl_h2o.training.config_file import save_config
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.environments import measure_observation_norm, preprocessing_of, task_of
from torchrl_h2o.training.film import try_to_film
from torchrl_h2o.training.judging import judge, run_settings, table_of_run, write_failure
from torchrl_h2o.training.loop import Method, train
from torchrl_h2o.training.mending import find_missing_effects


def run_job(cfg: DictConfig, directory: Path, methods: Sequence[Method]) -> None:
    """Trains, evaluates in reality, and writes summary.json, metrics.csv, learning_curve.png and a film.

    Args:
        cfg: the run's configuration.
        directory: the run's folder.
        methods: the main method, then its baselines.

    Raises:
        DivergenceError: if a loss or a parameter is no longer finite; summary.json then has the reason.
    """
    start = time.perf_counter()
    real = prepare(cfg, directory)
    cfg.mended = find_missing_effects(cfg, task_of(cfg), real, directory)
    save_config(cfg, directory)
    wall_s = time.perf_counter() - start

    policies, trainings = {}, {}
    for method in methods:
        try:
            policies[method.title], trainings[method.title] = train(method, cfg, real, directory)
        except DivergenceError as error:
            write_failure(directory, error.failure, run_settings(cfg, real))
            raise
    wall_s += sum(training.progress["seconds"] for training in trainings.values())

    in_reality = judge(cfg, real, policies, trainings, directory, wall_s)
    task, policy = task_of(cfg), policies[methods[0].title]
    film = try_to_film(task, preprocessing_of(cfg), policy, directory) if cfg.render else None
    tqdm.write(table_of_run(in_reality, directory, film, task.seconds_per_step))


def prepare(cfg: DictConfig, directory: Path) -> TensorDictBase:
    """Validates gap and report, loads the real data, and saves the configuration with the normalisation."""
    task = task_of(cfg)
    task.make_simulator()
    real = task.read_real_data(cfg.data, cfg.columns, cfg.data_seconds)
    measure_observation_norm(cfg, real)
    save_config(cfg, directory)
    return real
