"""The real transitions of a run: read from whatever ``data=`` names, or recorded once in ``env.reality`` and cached."""

import contextlib
import hashlib
import json
import os
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase

from torchrl_h2o import __version__
from torchrl_h2o.data import DataError, check_specs, episodes, load, read_ted, write_ted
from torchrl_h2o.envs import record
from torchrl_h2o.training.environments import make_reality
from torchrl_h2o.training.returns import Evaluation

RECORDED = "recorded"


def read_real_data(cfg: DictConfig) -> TensorDictBase:
    """Real transitions in TED, ``[T]``, checked against the task.

    Raises:
        ValueError: for ``data=recorded`` where the environment has nobody to record.
        torchrl_h2o.data.DataError: for data that cannot be read or do not fit the task.
    """
    if cfg.data == RECORDED:
        return _recorded(cfg)
    columns = cfg.columns
    if columns is None and Path(cfg.data).is_file() and Path(cfg.data).suffix not in (".hdf5", ".h5"):
        columns = cfg.env.get("columns")  # a log of this robot
    reward = instantiate(cfg.env.reward) if "reward" in cfg.env else None
    data = load(cfg.data, columns=columns, reward=reward, task=cfg.env.make.get("env_name", cfg.env.name))
    check_specs(data, make_reality(cfg, raw=True), source=cfg.data)
    return data


def _recorded(cfg: DictConfig) -> TensorDictBase:
    if "behaviour" not in cfg.env:
        raise ValueError(
            f"data=recorded needs a controller to record, and {cfg.env.name} has none: name a data set, "
            "such as data=halfcheetah/medium-replay-v0"
        )
    env = OmegaConf.to_container(cfg.env, resolve=True)
    made_of = [env[key] for key in ("make", "reality", "behaviour", "recording")]
    digest = hashlib.sha256(json.dumps([made_of, __version__], sort_keys=True).encode()).hexdigest()[:12]
    folder = _cache() / f"{cfg.env.name}_{digest}"
    if not folder.exists():
        data = record(make_reality(cfg, raw=True), instantiate(cfg.env.behaviour), **cfg.env.recording)
        with contextlib.suppress(DataError):  # another run, started at the same time, was faster
            write_ted(data, folder)
    return read_ted(folder)


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "torchrl_h2o"


def behaviour_in(cfg: DictConfig, data: TensorDictBase) -> Evaluation:
    """Returns and lengths of the data's episodes; the one that our own recording cut off counts only if alone."""
    whole = list(episodes(data))
    if cfg.data == RECORDED and len(whole) > 1 and not whole[-1]["next", "terminated"][-1]:
        whole.pop()
    returns = [float(episode["next", "reward"].sum()) for episode in whole]
    return Evaluation(returns, [len(episode) for episode in whole])
