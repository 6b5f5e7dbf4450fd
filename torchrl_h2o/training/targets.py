"""What the configuration in a run's folder may build: effects, environments, rewards and controllers of this library.

Hydra calls whatever a ``_target_`` names. The folder may come from somebody else, so its names are compared with a list
before anything is built. Names in a configuration that the user gives in this call, such as those in an own
env/mine.yaml, are not limited; to resume or evaluate such a run, the user lists them once more in ``trust``.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_h2o import effects
from torchrl_h2o.data import DataError
from torchrl_h2o.options.nearest import did_you_mean

GYM = "torchrl.envs.GymEnv"
#: names that any configuration may use: environments, reward functions and recording controllers, and all effects
TARGETS = frozenset(
    {
        GYM,
        "torchrl.envs.DMControlEnv",
        "torchrl_h2o.envs.WheelLeggedEnv",
        "torchrl_h2o.envs.wheel_legged.reward",
        "torchrl_h2o.envs.noisy_balance_controller",
    }
    | {
        f"torchrl_h2o.effects.{name}"
        for name in effects.__all__
        if inspect.isclass(cls := getattr(effects, name)) and issubclass(cls, effects.Effect)
    }
)
#: settings of Ray that neither start programs nor connect to a machine that the configuration names
RAY = {
    "init": {"include_dashboard", "log_to_driver", "logging_level", "num_cpus", "num_gpus"},
    "resources": {"num_cpus", "num_gpus", "memory", "max_restarts", "max_task_retries"},
}


def require_known_targets(
    cfg: DictConfig, source: Path, *, trust: bool | str | Iterable[str] | None = None, typed: DictConfig | None = None
) -> None:
    """Checks that a configuration from a file builds only what this library knows or the user trusts.

    Args:
        cfg: the configuration, not resolved.
        source: its file, for the error.
        trust: the option ``trust``: True for all names, or names such as ``my_package.MyEnv``.
        typed: the configuration of this call of the program. Names that it contains are allowed, because the user
            gave them.

    Raises:
        DataError: for another name; for an argument of a Gymnasium env that makes it import a module; and for settings
            of Ray that connect to other machines or start programs.

    Examples:
        >>> cfg = OmegaConf.create({"env": {"make": {"_target_": "os.system", "command": "ls"}}})
        >>> require_known_targets(cfg, Path("run/config.yaml"))
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: run/config.yaml, column 'env.make': _target_ 'os.system' is not ...
    """
    if trust is True:
        return
    allowed = {trust} if isinstance(trust, str) else set(trust or ())
    allowed |= foreign_names(typed).keys()
    refused = {name: why for name, why in foreign_names(cfg).items() if name not in allowed}
    for place, problem in refused.values():  # all names in the first error
        remedy = f"if you know who made this folder and what it runs, add trust=[{','.join(refused)}]"
        raise DataError(problem, remedy, source=source, column=place)


def foreign_names(cfg: DictConfig | None) -> dict[str, tuple[str, str]]:
    """The names in a configuration that only ``trust`` allows, each with its entry and the reason."""
    entries: Any = {} if cfg is None else OmegaConf.to_container(cfg, resolve=False, throw_on_missing=False)
    found: dict[str, tuple[str, str]] = {}
    for place, value in _walk(entries):
        if isinstance(value, Mapping) and "_target_" in value:
            target = str(value["_target_"])
            if target not in TARGETS or not isinstance(value["_target_"], str):
                problem = f"_target_ {target!r} is not one of this library's effects, envs, rewards and controllers"
                found.setdefault(target, (place, problem + did_you_mean(target, TARGETS)))
            elif target == GYM:  # Gymnasium imports the module before a task's colon, TorchRL the one of ``backend``
                for inner, name in _walk(value):
                    if isinstance(name, str) and (":" in name or inner == "backend"):
                        problem = f"the argument {name!r} of {GYM} may import a module of that name"
                        found.setdefault(name, (f"{place}.{inner}", problem))
    collector = entries.get("collector")
    for part, known in RAY.items():
        settings = collector.get(part) if isinstance(collector, Mapping) else None
        for key, value in settings.items() if isinstance(settings, Mapping) else ():
            if key not in known and value is not None:
                entry = f"collector.{part}.{key}"
                problem = f"{key}={value!r} of Ray starts programs or connects to other machines"
                found.setdefault(entry, (entry, problem))
    return found


def _walk(entries: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yields all values of nested mappings and lists with their places, the containers first."""
    yield place, entries
    if isinstance(entries, Mapping):
        for key, value in entries.items():
            yield from _walk(value, f"{place}.{key}" if place else str(key))
    elif isinstance(entries, list):
        for index, value in enumerate(entries):
            yield from _walk(value, f"{place}[{index}]")
