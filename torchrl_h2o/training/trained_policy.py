"""Loads the policy of a finished or interrupted run from its folder."""

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torchrl.checkpoint import Checkpoint, CheckpointRotation

from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.checkpoint import load_checkpoint
from torchrl_h2o.training.environments import make_reality
from torchrl_h2o.training.run_folder import checkpoint_folder, keeps_best


def load_policy(cfg: DictConfig, directory: str | Path, method: str = "H2O+") -> torch.nn.Module:
    """Load a policy from a method's last checkpoint: the last policy, or with ``keep=best_in_simulator`` the best one.

    Args:
        cfg: the run's configuration.
        directory: the run's folder.
        method: title of the method, such as ``"SAC in the simulator"``.

    Raises:
        FileNotFoundError: if the folder has no checkpoint of that method.
        torchrl_h2o.data.DataError: if the checkpoint contains more than tensors and numbers.
    """
    latest = CheckpointRotation(checkpoint_folder(directory, method), keep_last=1).latest()
    if latest is None:
        present = sorted(path.name for path in Path(directory, "checkpoints").glob("*"))
        raise FileNotFoundError(f"{directory} has no checkpoint of {method!r}; it has {present or 'none'}")
    env = make_reality(cfg)
    actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec_unbatched, cfg.num_cells)
    has_best = "policy" in Checkpoint.manifest(latest)["components"]  # offline methods have none
    component: dict[str, Any] = {"policy" if keeps_best(cfg) and has_best else "actor": actor}
    load_checkpoint(latest, Checkpoint(**component))
    return actor
