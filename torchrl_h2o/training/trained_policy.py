"""Loads the policy of a finished or interrupted run from its folder."""

from pathlib import Path

import torch
from omegaconf import DictConfig

from torchrl_h2o.data import DataError
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.checkpoint import checkpoint_file, load_checkpoint, read_checkpoint, require_widths
from torchrl_h2o.training.environments import keeps_best, make_reality


def load_policy(cfg: DictConfig, directory: str | Path, method: str = "H2O+") -> torch.nn.Module:
    """Load a policy from a method's last checkpoint: the last policy, or with ``keep=best_in_simulator`` the best one.

    Args:
        cfg: the run's configuration.
        directory: the run's folder.
        method: title of the method, such as ``"SAC in the simulator"``.

    Raises:
        FileNotFoundError: if the folder has no checkpoint of that method.
        torchrl_h2o.data.DataError: if the checkpoint is damaged, has other networks than the configuration, or its
            environment cannot be built.
    """
    path = checkpoint_file(directory, method)
    if not path.exists():
        present = sorted(other.stem for other in path.parent.glob("*.pt"))
        raise FileNotFoundError(f"{directory} has no checkpoint of {method!r}; it has {present or 'none'}")
    require_widths(cfg, path)
    try:
        env = make_reality(cfg)
    except Exception as error:  # arguments of a stranger's env or effect may be anything
        problem, remedy = f"its env cannot be built: {error}", "give the folder of a run, with the config.yaml it wrote"
        raise DataError(problem, remedy, source=Path(directory, "config.yaml"), column="env") from error
    actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec_unbatched, cfg.num_cells)
    has_best = "policy" in read_checkpoint(path, mmap=True)["components"]  # offline methods have none
    load_checkpoint(path, {"policy" if keeps_best(cfg) and has_best else "actor": actor})
    return actor
