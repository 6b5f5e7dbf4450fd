"""A population of H2O+ runs: trained at once, judged one by one, each with its files in a folder of its own."""

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
    """The same for many runs at once, each with its files in a folder of its own; no baseline and no films."""
    start = time.perf_counter()
    for own in members.values():
        make_simulator(own, raw=True)  # a gap that there is not
    real = prepare(cfg, directory)
    members = members_of(cfg)  # with what was measured from the data
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
