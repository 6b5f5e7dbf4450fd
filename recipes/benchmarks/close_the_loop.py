"""Measures how often close_the_loop finds randomly drawn effects from a simulator and data.

python recipes/benchmarks/close_the_loop.py                                    # the whole table, some hours
python recipes/benchmarks/close_the_loop.py cases=[paper16,nothing] draws=3
python recipes/benchmarks/close_the_loop.py cases=[several] numbers=[7]        # one case again
python recipes/benchmarks/close_the_loop.py logs=path/to/logs                  # with the two real robots

Writes results.json, results.csv (one row per case) and each case's report.html to the run's folder.
"""

from pathlib import Path

from families import choose_families
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from options import CloseTheLoopBenchmarkOptions
from results_table import print_speed, print_table
from running import Job, run_all
from speed import steps_per_second
from systems import SYSTEMS

import torchrl_h2o.quiet  # noqa: F401  (silences other packages)
from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.residuals import Simulation, close_the_loop


@hydra_main("../config", "close_the_loop_benchmark", CloseTheLoopBenchmarkOptions)
def main(cfg: DictConfig) -> None:
    directory = Path(HydraConfig.get().runtime.output_dir)
    logs = None if cfg.logs is None else Path(cfg.logs).resolve()
    families = choose_families(cfg.cases, logs)
    jobs = [
        Job(name, number, cfg.seed, directory, logs)
        for name, family in families.items()
        for number in (cfg.numbers if cfg.numbers is not None else range(min(family.size, cfg.draws or family.size)))
        if number < family.size
    ]
    rows = run_all(jobs, cfg.processes, close_the_loop)
    print_table(families, rows, directory)
    print_speed(rows, steps_per_second(Simulation.from_env(SYSTEMS["HalfCheetah"].env())), cfg.processes)


if __name__ == "__main__":
    main()
