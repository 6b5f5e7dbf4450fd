"""Trains any method of the comparison, on the same data, simulator and budget, and shows what it does in reality.

python recipes/train.py method=iql           # or sac, cql, darc, h2o, h2o_plus, rlpd, td3
python recipes/train.py method=darc env=halfcheetah gap=gravity data=halfcheetah/medium-replay-v0
python recipes/train.py --multirun method=sac,h2o,h2o_plus seed=0,1,2      # one after the other
python recipes/train.py --multirun hydra/launcher=joblib method=sac,h2o    # at once
python recipes/train.py resume=outputs/wheel_legged/...                    # go on after an interruption
"""

import torchrl_h2o.quiet  # noqa: F401, I001  (before the packages that it keeps quiet)

from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from torchrl_h2o.training.job import run_job
from torchrl_h2o.training.methods import method_named
from omegaconf import DictConfig, OmegaConf
from torchrl_h2o.training.populations.loop import members_of
from torchrl_h2o.comparison.results_file import append_run
from torchrl_h2o.training.run_folder import claimed, open_run, resumable


@hydra.main(config_path="config", config_name="train", version_base=None)
def main(cfg: DictConfig) -> None:
    if OmegaConf.is_missing(cfg, "resume"):
        cfg.overrides = list(HydraConfig.get().overrides.task)
    if members_of(cfg):
        raise ValueError("populations are h2o_plus.py's; here: --multirun seed=0,1 gap=gravity,friction")
    cfg, directory = open_run(cfg)
    with claimed(directory), resumable(directory):
        train_and_record(cfg, directory)


def train_and_record(cfg: DictConfig, directory: Path) -> None:
    """A run of one method, and its rows in the results; of one that is done, the rows alone."""
    if not (directory / "summary.json").exists():
        run_job(cfg, directory, [method_named(cfg.method)])
    if cfg.results is not None:
        append_run(Path(cfg.results), cfg, directory)


if __name__ == "__main__":
    main()
