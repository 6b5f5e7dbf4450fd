"""Runs the paper's tables and figures as grids of training runs; finished runs are skipped.

python recipes/paper.py table=returns                          # every task, gap, method and seed of the main table
python recipes/paper.py table=returns methods=[h2o_plus,iql] gaps=[gravity] seeds=[0,1] updates=100000
python recipes/paper.py figure=wheel_legged seeds=[0,1,2] hydra/launcher=joblib hydra.launcher.n_jobs=2
python recipes/paper.py table=methods tasks=[mine] results=mine.csv     # your own task, config/env/mine.yaml
python recipes/paper.py table=mixing hydra/launcher=submitit_slurm      # or hydra/launcher=ray

After Ctrl-C, the same command continues. recipes/report.py makes tables and figures from the results.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.comparison.grids import check_overrides, chosen_grid, group_name
from torchrl_h2o.comparison.launching import GridLauncher, shared_overrides
from torchrl_h2o.comparison.options import PaperOptions
from torchrl_h2o.comparison.recorded_run import train_grid_run
from torchrl_h2o.comparison.results_file import RESULTS
from torchrl_h2o.options.types import why_unavailable

ON_THIS_MACHINE = ("basic", "joblib")  # Hydra's launchers that train here


@hydra_main("config", "paper", PaperOptions)
def main(cfg: DictConfig) -> None:
    launcher = HydraConfig.get().runtime.choices["hydra/launcher"]
    if launcher in ON_THIS_MACHINE and (problem := why_unavailable(cfg.device)):
        raise ValueError(f"device={cfg.device}: {problem}, or a launcher of machines that have one")
    shared = shared_overrides(HydraConfig.get().overrides.task)
    results = Path(cfg.results or RESULTS / f"{group_name(cfg)}.csv").resolve()
    runs = list(chosen_grid(cfg).runs(tuple(cfg.seeds)))
    check_overrides(shared, runs)
    grid = GridLauncher.of_this_job(results, shared, train_grid_run)
    try:
        failed = grid.run(runs, cfg.retries)
    except KeyboardInterrupt:
        sys.exit(f"\ninterrupted with {len(grid.remaining(runs))} runs to go; the same command continues with them")
    if failed:
        sys.exit("\n".join(["these runs failed:", *failed]))


if __name__ == "__main__":
    main()
