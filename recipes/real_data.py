"""The real transitions of a run: read from whatever ``data=`` names, or recorded once in ``env.reality`` and cached."""

import hashlib
import json
import os
from pathlib import Path

from environments import make_reality
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase

from torchrl_h2o import __version__
from torchrl_h2o.data import check_specs, episodes, load, read_ted, write_ted
from torchrl_h2o.envs import record

RECORDED = "recorded"


def read_real_data(cfg: DictConfig) -> TensorDictBase:
    """Real transitions in TED, ``[T]``, checked against the task.

    Raises:
        ValueError: for ``data=recorded`` where the environment has nobody to record.
        torchrl_h2o.data.DataError: for data that cannot be read or do not fit the task.
    """
    if cfg.data == RECORDED:
        return _recorded(cfg)
    columns = cfg.columns or cfg.env.get("columns")
    reward = instantiate(cfg.env.reward) if "reward" in cfg.env else None
    data = load(cfg.data, columns=columns, reward=reward)
    check_specs(data, make_reality(cfg, raw=True), source=cfg.data)
    return data


def _recorded(cfg: DictConfig) -> TensorDictBase:
    if "behaviour" not in cfg.env:
        raise ValueError(
            f"data=recorded needs a controller to record, and {cfg.env.name} has none: name a data set, "
            "such as data=halfcheetah/medium-replay-v0"
        )
    made_of = OmegaConf.to_container(OmegaConf.masked_copy(cfg.env, ["make", "reality", "behaviour", "recording"]))
    digest = hashlib.sha256(json.dumps([made_of, __version__], sort_keys=True).encode()).hexdigest()[:12]
    folder = _cache() / f"{cfg.env.name}_{digest}"
    if not folder.exists():
        data = record(make_reality(cfg, raw=True), instantiate(cfg.env.behaviour), **cfg.env.recording)
        write_ted(data, folder)
    return read_ted(folder)


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "torchrl_h2o"


def episode_returns(data: TensorDictBase) -> list[float]:
    """Undiscounted returns of the data's episodes; one that the end of the recording cut counts only if alone."""
    whole = list(episodes(data))
    if len(whole) > 1 and not whole[-1]["next", "terminated"][-1]:
        whole.pop()
    return [float(episode["next", "reward"].sum()) for episode in whole]
