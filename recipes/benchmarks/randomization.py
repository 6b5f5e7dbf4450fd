"""Compares domain randomisation by measured ranges with ± 20 % of everything and with none, on series of machines.

python recipes/benchmarks/randomization.py                                  # both series, an hour on one core
python recipes/benchmarks/randomization.py series=[arm] seeds=[0] updates=4000

The machines of a series differ in what their simulator lacks. The first ones give logs, from which close_the_loop
measures ranges. SAC trains in worlds drawn from these ranges, in worlds of the usual ranges, without randomisation,
and in machines drawn like the series itself, the best that ranges could be. Each policy is evaluated in further
machines, which gave no log. Writes the reports and a record of each policy to outputs/benchmark/randomization, skips
those that are there, and prints the means over seeds.
"""

from collections.abc import Iterator, Sequence
from itertools import islice, product
from pathlib import Path

import pandas as pd
import torch
from machine_series import SERIES, WORLDS, Series
from omegaconf import DictConfig, OmegaConf
from options import read_options, run_options
from tensordict import TensorDict
from torch.optim.lr_scheduler import LinearLR
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from tqdm import tqdm

import torchrl_h2o.quiet  # noqa: F401  (before the packages that it keeps quiet)
from torchrl_h2o.commands.one_line_errors import one_line_errors
from torchrl_h2o.comparison.records import Record, read_records
from torchrl_h2o.comparison.series_tables import series_tables
from torchrl_h2o.provenance import cpu_seconds
from torchrl_h2o.residuals import Report, close_the_loop
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.populations import PopulationReplay
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.progress import Budget
from torchrl_h2o.training.returns import evaluate
from torchrl_h2o.whole_file import write_text

TABLE = "randomization"
LOGGED, EVALUATED = 0, 1  # random streams of machines; those of trainings follow
CHOSEN = ("series", "worlds_of", "seeds", "threads", "folder")  # options that do not change a run
Run = tuple[str, int]  # the worlds of the training, and its seed


def report_of(series: Series, logs: TensorDict, folder: Path, minutes: float) -> Report:
    """Closes the loop on all logs together, or reads the report of an earlier call."""
    if not (folder / "report.json").exists():
        close_the_loop(series.simulator(), logs, source=series.system, minutes=minutes).save(folder)
    return Report.load(folder)


def train(
    envs: Sequence[EnvBase], seeds: Sequence[int], logs: TensorDict, preprocessing: Preprocessing, cfg: DictConfig
) -> list[torch.nn.Module]:
    """Trains a SAC policy in each env, all at once with stacked networks; the logs only fill a stream of no rows."""
    real, batch_size = preprocessing.apply(logs), (0, sum(cfg.batch_size))
    replay = PopulationReplay(real, cfg.sim_capacity_min, batch_size, len(envs), n_steps=cfg.n_steps, gamma=cfg.gamma)
    learners, collectors = [], []
    for env, seed, buffer in zip(envs, seeds, replay.buffers, strict=True):
        own, sizes = OmegaConf.merge(cfg, {"seed": seed}), (real["observation"].shape[-1], env.action_spec_unbatched)
        learners.append(METHODS["sac"].make_learner(own, *sizes, buffer))
        collectors.append(Collector(env, learners[-1].actor, frames_per_batch=cfg.steps_per_epoch))
        collectors[-1].set_seed(seed)
    population, epochs = PopulationLearner(learners, replay, cfg.lr, cfg.tau), Budget.from_config(cfg).epochs
    schedule = LinearLR(population.optimiser, 1.0, cfg.lr_end_factor, total_iters=epochs)
    with tqdm(total=epochs * cfg.updates_per_epoch, desc=f"{len(envs)} policies", unit=" updates") as bar:
        for rollouts in islice(zip(*collectors, strict=True), epochs):
            for simulated, buffer in zip(rollouts, replay.buffers, strict=True):
                simulated["next", "reward"] = preprocessing.reward(simulated["next", "reward"])
                buffer.extend(simulated)
            for _ in range(cfg.updates_per_epoch):
                population.update()
                bar.update()
            schedule.step()
    return [learner.actor for learner in learners]


def train_and_evaluate(name: str, runs: Sequence[Run], cfg: DictConfig) -> Iterator[Record]:
    """Trains policies for a series and evaluates each of them in machines that gave no log."""
    series, start = SERIES[name], cpu_seconds()
    logs = series.logs(series.machines(cfg.logs, cfg.scatter, stream=LOGGED), cfg.rows, cfg.noise)
    report = report_of(series, logs, Path(cfg.folder) / "reports" / name, cfg.minutes)
    budget = [f"{key}={cfg[key]}" for key in ("updates", "updates_per_epoch", "steps_per_epoch")]
    run = run_options("method=sac", *series.options, *budget)
    scaling = {"reward_scale": run.reward_scale, "reward_offset": run.reward_offset}
    preprocessing = Preprocessing.fit(logs, normalise=True, **scaling)
    envs = []
    for worlds, seed in runs:
        machines = series.machines(cfg.worlds, cfg.scatter, stream=EVALUATED + 1 + seed)
        envs.append(series.env(WORLDS[worlds](series, report, machines, seed), preprocessing))
    actors = train(envs, [seed for _, seed in runs], logs, preprocessing, run)
    reality = series.env(series.machines(cfg.machines, cfg.scatter, stream=EVALUATED), preprocessing)
    cost = (cpu_seconds() - start) / len(runs)
    for (worlds, seed), actor, env in zip(runs, actors, envs, strict=True):
        begin, found = cpu_seconds(), evaluate(reality, actor, cfg.machines)
        values = {"series": name, "worlds": worlds, "seed": seed, "updates": cfg.updates, "return": found.mean}
        values |= {"return in training's worlds": evaluate(env, actor, cfg.worlds).mean, "returns": found.returns}
        values |= {series.score[0]: series.score[1](found), "report": report.sentence()}
        yield Record.of_this_process(TABLE, name_of(name, worlds, seed, cfg.updates), values, begin - cost)


def name_of(series: str, worlds: str, seed: int, updates: int) -> str:
    words = worlds.replace("±", "").replace("%", "percent").split()
    return "_".join([series, *words, f"{updates}_updates", f"seed{seed}"])


def claim(folder: Path, cfg: DictConfig) -> None:
    """Stores the options of the runs in their folder.

    Raises:
        ValueError: if the folder has runs with other options.
    """
    path, own = folder / "options.yaml", OmegaConf.masked_copy(cfg, [key for key in cfg if key not in CHOSEN])
    if path.exists() and OmegaConf.load(path) != own:
        raise ValueError(f"{path} has other options: give these, or choose another folder=")
    write_text(path, OmegaConf.to_yaml(own))


def main() -> None:
    cfg = read_options(
        series=list(SERIES),
        worlds_of=list(WORLDS),
        seeds=[0, 1, 2, 3, 4],
        logs=4,  # machines that give a log
        rows=3000,  # of a log
        noise=0.01,  # of the sensors in the logs, as a share of each signal's standard deviation
        scatter=0.2,  # standard deviation of a value over the series, as a share of it
        minutes=20,  # of close_the_loop
        worlds=20,  # of each training
        machines=20,  # of the evaluation
        updates=8000,
        updates_per_epoch=1000,
        steps_per_epoch=2000,  # simulated, of all worlds together
        threads=1,  # of torch
        folder="outputs/benchmark/randomization",
    )
    torch.set_num_threads(cfg.threads)
    claim(Path(cfg.folder), cfg)
    records = {record.name: record for record in read_records(Path(cfg.folder), TABLE)}
    wanted = [name_of(*run, cfg.updates) for run in product(cfg.series, cfg.worlds_of, cfg.seeds)]
    for name in cfg.series:
        left = [run for run in product(cfg.worlds_of, cfg.seeds) if name_of(name, *run, cfg.updates) not in records]
        for record in train_and_evaluate(name, left, cfg) if left else ():
            record.save(Path(cfg.folder))
            records[record.name] = record
    columns = ["return", "return in training's worlds", *(series.score[0] for series in SERIES.values())]
    runs = pd.DataFrame(
        [records[name].values for name in wanted], columns=["series", "updates", "worlds", "seed", *columns]
    )
    print(f"\n{series_tables(runs, cfg.worlds_of, columns)}\n\nresults    {cfg.folder}/{TABLE}")


if __name__ == "__main__":
    with one_line_errors():
        main()
