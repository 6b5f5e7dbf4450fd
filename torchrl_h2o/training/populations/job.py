"""Train a population of H2O+ runs together, evaluate each, and write each one's files into a folder of its own."""

import time
from pathlib import Path

from omegaconf import DictConfig

from torchrl_h2o.training.environments import make_simulator
from torchrl_h2o.training.job import prepare
from torchrl_h2o.training.judging import judge, judge_failed
from torchrl_h2o.training.methods.h2o_plus import make_learner
from torchrl_h2o.training.populations.loop import members_of, train_population
from torchrl_h2o.training.printout import print_population
from torchrl_h2o.training.real_data import behaviour_in


def run_population(cfg: DictConfig, members: dict[str, DictConfig], directory: Path) -> None:
    """Train and evaluate all members; without a baseline and without films.

    Args:
        cfg: the settings that the members share.
        members: each member's settings, by name.
        directory: the population's folder.
    """
    start = time.perf_counter()
    for own in members.values():
        make_simulator(own, raw=True)  # an unknown gap fails before the data are read
    real = prepare(cfg, directory)
    members = members_of(cfg)  # again, with the statistics measured from the data
    wall_s = time.perf_counter() - start
    outcomes = train_population(make_learner, cfg, members, real, directory)
    in_reality = {}
    for name, outcome in outcomes.items():
        own, folder = members[name], directory / name
        if outcome.failure is None:
            so_far_s = wall_s + outcome.seconds
            in_reality[name] = judge(own, real, {"H2O+": outcome.policy}, {"H2O+": outcome}, folder, so_far_s)["H2O+"]
        else:
            judge_failed(own, real, outcome.failure, folder)
            in_reality[name] = None
    print_population(cfg, in_reality | {"the data's behaviour": behaviour_in(cfg, real)}, directory)
