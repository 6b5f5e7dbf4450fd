"""Real transitions of a run, read from a data set or a log, or recorded once in ``reality`` and cached."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_h2o.data import check_specs, episodes, load, read_ted, write_ted
from torchrl_h2o.data.readers.sources import Source, is_log, words_of
from torchrl_h2o.envs import record
from torchrl_h2o.options.sources import RECORDED
from torchrl_h2o.training.cache import SIMULATES, cache_folder, cached, key_of
from torchrl_h2o.training.returns import Evaluation


def read_real_data(
    config: Mapping[str, Any], reality: EnvBase, data: Source, columns: str | None = None
) -> TensorDictBase:
    """Reads real transitions in TED, ``[T]``, and checks them against the task.

    Args:
        config: the ``env`` section of a configuration, see :class:`~torchrl_h2o.training.task.Task`.
        reality: one env of the task, with observations in physical units.
        data: ``"recorded"``, or a source for :func:`torchrl_h2o.data.load`: a data set's name, a file or a folder, or
            several logs: a list, a glob or a folder.
        columns: YAML file that describes a log's columns. Defaults to ``columns`` of the configuration.

    Raises:
        ValueError: for ``"recorded"`` if the task has no controller for recording.
        torchrl_h2o.data.DataError: if the data cannot be read or do not fit the task.
    """
    if data == RECORDED:
        return _recorded(config, reality)
    if columns is None and is_log(data):
        columns = config.get("columns")
    reward = instantiate(config["reward"]) if "reward" in config else None
    real = load(data, columns=columns, reward=reward, task=config["make"].get("env_name", config["name"]))
    check_specs(real, reality, source=words_of(data))
    return real


def first_seconds(real: TensorDictBase, seconds: float, seconds_per_step: float) -> TensorDictBase:
    """Selects the first seconds of real data and marks the last transition as the end of its episode.

    The rows do not depend on a seed, so all methods and seeds that use the same amount of data use the same rows.
    Episodes that end within the selection keep their ends.

    Args:
        real: the measured transitions, ``[T]``.
        seconds: duration of the selection, in s; rounded to whole control steps.
        seconds_per_step: control step, in s.

    Returns:
        A new tensordict, ``[round(seconds / seconds_per_step)]``. Its last transition is done: truncated, unless the
        episode terminates there.

    Raises:
        ValueError: if the data are shorter, or the selection has no transition.

    Example:
        >>> from torchrl_h2o.envs import WheelLeggedEnv
        >>> real = WheelLeggedEnv(max_episode_steps=10).rollout(30, break_when_any_done=False)
        >>> part = first_seconds(real, 0.12, seconds_per_step=0.005)
        >>> part["next", "truncated"].flatten().nonzero().flatten().tolist()
        [9, 19, 23]
    """
    rows = round(seconds / seconds_per_step)
    if not 0 < rows <= len(real):
        raise ValueError(
            f"data_seconds={seconds:g} selects {rows} transitions of {seconds_per_step:g} s, but the real data have "
            f"{len(real)}, {len(real) * seconds_per_step:g} s: choose at most that, or leave data_seconds out for all"
        )
    part = cast(TensorDictBase, real[:rows]).clone()
    following = cast(TensorDictBase, part["next"])
    following["truncated"][-1] |= ~following["terminated"][-1]
    following["done"][-1] = True
    return part


def _recorded(config: Mapping[str, Any], reality: EnvBase) -> TensorDictBase:
    if "behaviour" not in config:
        raise ValueError(
            f"data=recorded needs a controller to record, and {config['name']} has none: name a data set, "
            "such as data=halfcheetah/medium-replay-v0"
        )
    made_of = [config[key] for key in ("make", "reality", "behaviour", "recording")]
    name = re.sub(r"[^\w-]+", "_", config["name"])  # no path, because a folder from somebody else may name the env
    folder = cache_folder() / f"{name}_{key_of(made_of, reality, SIMULATES)}"

    def record_into(folder: Path) -> None:
        write_ted(record(reality, instantiate(config["behaviour"]), **config["recording"]), folder)

    return read_ted(cached(folder, record_into))


def is_cut(cfg: DictConfig) -> bool:
    """Whether the real data stop after a number of transitions, whatever the state of the last episode."""
    return cfg.data == RECORDED or cfg.get("data_seconds") is not None


def behaviour_of(real: TensorDictBase, *, cut: bool) -> Evaluation:
    """Returns and lengths of the episodes in the data.

    Args:
        real: the measured transitions, ``[T]``.
        cut: whether the data stop after a number of transitions, see :func:`is_cut`. Their last episode is then
            incomplete; it is left out unless it terminated or is the only one.
    """
    whole = list(episodes(real))
    if cut and len(whole) > 1 and not whole[-1]["next", "terminated"][-1]:
        whole.pop()
    returns = [float(episode["next", "reward"].sum()) for episode in whole]
    return Evaluation(returns, [len(episode) for episode in whole])
