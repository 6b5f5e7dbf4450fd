"""Trains H2O+ from real data and an imperfect simulator, and shows what its policy does in reality.

python recipes/h2o_plus.py                                             # the wheel-legged robot, nothing downloaded
python recipes/h2o_plus.py data=standing_still.txt                     # the same with the real robot's log
python recipes/h2o_plus.py env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0
python recipes/h2o_plus.py gap_fix=outputs/close_the_loop/.../report.json     # in the simulator, mended
python recipes/h2o_plus.py backbone=sparse mixing=0.5 ratio=false      # anything in config/ can be overridden
python recipes/h2o_plus.py seeds=[0,1,2,3,4] gaps=[gravity,friction]   # ten runs at once, stacked
python recipes/h2o_plus.py resume=outputs/wheel_legged/...             # go on after an interruption
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages that it keeps quiet)


import hydra
from omegaconf import DictConfig

from torchrl_h2o.training.job import resumable, run_job
from torchrl_h2o.training.methods.h2o_plus import H2O_PLUS, make_value_loss
from torchrl_h2o.training.methods.sac import SAC
from torchrl_h2o.training.populations.job import run_population
from torchrl_h2o.training.populations.loop import members_of
from torchrl_h2o.training.run_folder import claimed, open_run


@hydra.main(config_path="config", config_name="h2o_plus", version_base=None)
def main(cfg: DictConfig) -> None:
    cfg, directory = open_run(cfg)
    make_value_loss(cfg, observation_dim=1)  # a backbone that there is not: said before the data are read
    with claimed(directory), resumable(directory):
        if members := members_of(cfg):
            run_population(cfg, members, directory)
        else:
            run_job(cfg, directory, [H2O_PLUS, SAC] if cfg.baseline else [H2O_PLUS])


if __name__ == "__main__":
    main()
