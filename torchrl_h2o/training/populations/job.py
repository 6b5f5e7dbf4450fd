"""A population of H2O+ runs: trained together, then evaluated one by one, each with files in its own folder."""

import time
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.environments import task_of
from torchrl_h2o.training.job import prepare
from torchrl_h2o.training.judging import DATA, best_trial, judge, run_settings, table_of_population, write_failure
from torchrl_h2o.training.mending import find_missing_effects
from torchrl_h2o.training.methods.h2o_plus import make_learner
from torchrl_h2o.training.populations.loop import members_of, train_population
from torchrl_h2o.training.real_data import behaviour_of, is_cut


def run_population(cfg: DictConfig, members: dict[str, DictConfig], directory: Path) -> None:
    """Trains all members together, evaluates each, and writes the files of each, without films.

    Args:
        cfg: the configuration that the members share.
        members: the configuration of each member, by name.
        directory: the population's folder.

    Raises:
        DivergenceError: at the end, with the members that diverged.
    """
    start = time.perf_counter()
    for own in members.values():
        task_of(own).make_simulator()  # fails before the data are loaded if a gap does not fit the model
    real = prepare(cfg, directory)
    members = members_of(cfg)  # again, because ``prepare`` has added the normalisation of the observations
    for name, own in members.items():
        (directory / name).mkdir(parents=True, exist_ok=True)
        own.mended = find_missing_effects(own, task_of(own), real, directory / name)
    wall_s = time.perf_counter() - start
    outcomes = train_population(make_learner, cfg, members, real, directory)
    in_reality = {}
    for name, outcome in outcomes.items():
        own, folder = members[name], directory / name
        if outcome.failure is not None:
            write_failure(folder, outcome.failure, run_settings(own, real))
            in_reality[name] = None
            continue
        found = judge(own, real, {"H2O+": outcome.policy}, {"H2O+": outcome}, folder, wall_s + outcome.seconds)
        in_reality[name] = found["H2O+"]
    trials = None
    if len(cfg.gaps or [None]) == 1:  # returns in different simulators cannot be compared
        trials = {name: best_trial(outcome.rows) for name, outcome in outcomes.items() if outcome.failure is None}
    behaviour = {DATA: behaviour_of(real, cut=is_cut(cfg))}
    tqdm.write(table_of_population(in_reality | behaviour, directory, task_of(cfg).seconds_per_step, trials))
    failures = {name: outcome.failure for name, outcome in outcomes.items() if outcome.failure is not None}
    if failures:
        which = ", ".join(f"{name} after {one['updates']:,} updates ({one['why']})" for name, one in failures.items())
        raise DivergenceError(
            f"{len(failures)} of {len(outcomes)} members diverged: {which}; the others are complete in {directory}; "
            "train these with a smaller lr or reward_scale.",
            which,
            min(one["updates"] for one in failures.values()),
        )
