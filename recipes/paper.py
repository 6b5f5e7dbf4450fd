"""The paper's tables and figures: grids of runs, of which those that are done are not run again.

python recipes/paper.py table=returns                          # every task, gap, method and seed of the main table
python recipes/paper.py table=returns methods=[h2o_plus,iql] gaps=[gravity] seeds=[0,1] updates=100000
python recipes/paper.py figure=wheel_legged seeds=[0,1,2] hydra/launcher=joblib hydra.launcher.n_jobs=2
python recipes/paper.py table=methods tasks=[mine] results=mine.csv     # your own, config/env/mine.yaml
PYTHONPATH=$PWD/recipes python recipes/paper.py table=mixing hydra/launcher=submitit_slurm     # or ...=ray

Ctrl-C loses nothing: the same command goes on. recipes/report.py makes tables and pictures of what is there.
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages that it keeps quiet)

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torchrl_h2o.training.run_folder import claimed, open_run
from train import train_and_record

from torchrl_h2o.comparison.sweeper import register_sweeper


@hydra.main(config_path="config", config_name="paper", version_base=None)
def main(cfg: DictConfig) -> None:
    """One run of the grid; the sweeper, hydra_plugins/paper_grid.py, has chosen it."""
    cfg.overrides = list(HydraConfig.get().overrides.task)
    cfg.seeds = cfg.gaps = None  # of the grid; this is one run, also for h2o_plus.py
    results = cfg.results
    cfg, directory = open_run(cfg, go_on=True)
    cfg.results = results  # a run that goes on may have been begun for another file
    with claimed(directory):
        train_and_record(cfg, directory)


if __name__ == "__main__":
    register_sweeper()
    main()
