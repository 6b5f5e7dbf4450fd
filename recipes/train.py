"""Trains any method of the comparison on the same data, simulator and budget, and evaluates it in reality.

python recipes/train.py method=iql           # or sac, cql, td3_bc, darc, h2o, h2o_plus, rlpd, td3, par, dara, vgdf
python recipes/train.py method=h2o_plus baselines=[sac]                    # both, in one table and picture
python recipes/train.py method=darc env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0
python recipes/train.py seeds=[0,1,2,3,4] gaps=[gravity,friction]          # ten runs of H2O+ at once, stacked
python recipes/train.py collector=multi_sync collector.workers=2           # simulators in worker processes
python recipes/train.py --multirun hydra/launcher=joblib method=sac,h2o seed=0,1,2    # a grid, in parallel
python recipes/train.py resume=outputs/wheel_legged/...                    # continue an interrupted run
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (must precede the packages that it silences)

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchrl_h2o.commands.hydra_main import hydra_main
from torchrl_h2o.comparison.recorded_run import train_and_record
from torchrl_h2o.options import TrainOptions
from torchrl_h2o.training.populations.job import run_population
from torchrl_h2o.training.populations.loop import members_of
from torchrl_h2o.training.run_folder import claimed, open_run, resumable


@hydra_main("config", "train", TrainOptions)
def main(cfg: DictConfig) -> None:
    if OmegaConf.is_missing(cfg, "resume"):
        cfg.overrides = list(HydraConfig.get().overrides.task)
    cfg, directory = open_run(cfg)
    with claimed(directory), resumable(directory):
        if members := members_of(cfg):
            run_population(cfg, members, directory)
        else:
            train_and_record(cfg, directory)


if __name__ == "__main__":
    main()
