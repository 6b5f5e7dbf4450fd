"""One job: methods trained on the same data, judged in reality, and the files that tell of it."""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from omegaconf import DictConfig
from tensordict import TensorDictBase

from torchrl_h2o.training.collection import check_collector
from torchrl_h2o.training.environments import make_simulator, measure_observation_norm
from torchrl_h2o.training.film import try_to_film
from torchrl_h2o.training.judging import judge
from torchrl_h2o.training.loop import Method, train
from torchrl_h2o.training.printout import print_table
from torchrl_h2o.training.real_data import read_real_data
from torchrl_h2o.training.run_folder import save_config


@contextmanager
def resumable(directory: Path) -> Iterator[None]:
    """Tells the user of a run that is interrupted how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted; go on with: python {sys.argv[0]} resume={os.path.relpath(directory)}")


def run_job(cfg: DictConfig, directory: Path, methods: Sequence[Method]) -> None:
    """Trains, evaluates in reality, and leaves summary.json, metrics.csv, learning_curve.png and a film.

    Args:
        cfg: the run's configuration.
        directory: its folder.
        methods: the one that the job is about, and baselines to set it beside.
    """
    start = time.perf_counter()
    real = prepare(cfg, directory)
    wall_s = time.perf_counter() - start

    policies, trainings = {}, {}
    for method in methods:
        policy, training = train(method, cfg, real, directory)
        policies[method.title], trainings[method.title] = policy, training
    wall_s += sum(training.progress["seconds"] for training in trainings.values())

    in_reality = judge(cfg, real, policies, trainings, directory, wall_s)
    film = try_to_film(cfg, policies[methods[0].title], directory) if cfg.render else None
    print_table(cfg, in_reality, directory, film)


def prepare(cfg: DictConfig, directory: Path) -> TensorDictBase:
    """The real data. What there is not, gap, report or collector, is said before they are read."""
    make_simulator(cfg, raw=True)
    check_collector(cfg)
    real = read_real_data(cfg)
    measure_observation_norm(cfg, real)
    save_config(cfg, directory)
    return real
