"""What the configuration in a run's folder may build: effects, environments, rewards and controllers of this library.

Hydra calls whatever a ``_target_`` names. The folder may come from somebody else, so its names are compared with a list
before anything is built. Names in a configuration that the user gives in this call, such as those in an own
env/mine.yaml, are not limited; to resume or evaluate such a run, the user lists them once more in ``trust``.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_h2o import effects
from torchrl_h2o.data import DataError

_GYM = "torchrl.envs.GymEnv"
#: names that any configuration may use: environments, reward functions and recording controllers, and all effects
TARGETS = frozenset(
    {
        _GYM,
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
_RAY_INIT = {"include_dashboard", "log_to_driver", "logging_level", "num_cpus", "num_gpus"}
_RAY_RESOURCES = {"num_cpus", "num_gpus", "memory", "max_restarts", "max_task_retries"}


@dataclass(frozen=True)
class Use:
    """A use of something that a configuration names.

    Args:
        place: the entry, such as ``env.make``.
        name: what must be trusted to allow it: the ``_target_``, or the entry itself for a setting.
        problem: why it is refused unless it is trusted; None if it is always allowed.
    """

    place: str
    name: str
    problem: str | None = None


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
        DataError: for another name; for an interpolation such as ``${oc.env:HOME}``, which a saved configuration never
            has; for an argument of a Gymnasium env that makes it import a module; and for settings of Ray that connect
            to other machines or start programs.

    Examples:
        >>> cfg = OmegaConf.create({"env": {"make": {"_target_": "os.system", "command": "ls"}}})
        >>> require_known_targets(cfg, Path("run/config.yaml"))
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: run/config.yaml, column 'env.make': _target_ 'os.system' is not ...
    """
    entries: Any = OmegaConf.to_container(cfg, resolve=False)
    _refuse_interpolations(entries, source)
    if trust is True:
        return
    own: Any = {} if typed is None else OmegaConf.to_container(typed, resolve=False, throw_on_missing=False)
    allowed = {use.name for use in _uses(own)} | _names(trust)
    refused = [use for use in _uses(entries) if use.problem is not None and use.name not in allowed]
    if refused:
        names = ",".join(dict.fromkeys(use.name for use in refused))
        raise DataError(
            str(refused[0].problem),
            f"if you know who made this folder and what it runs, add trust=[{names}]",
            source=source,
            column=refused[0].place,
        )


def foreign_names(cfg: DictConfig) -> list[str]:
    """The names in a configuration that only ``trust`` allows, each once."""
    entries: Any = OmegaConf.to_container(cfg, resolve=False, throw_on_missing=False)
    return list(dict.fromkeys(use.name for use in _uses(entries) if use.problem is not None))


def _names(trust: bool | str | Iterable[str] | None) -> set[str]:
    if not trust or isinstance(trust, bool):
        return set()
    return {trust} if isinstance(trust, str) else set(trust)


def _refuse_interpolations(entries: Any, source: Path) -> None:
    for place, value in _walk(entries):
        if isinstance(value, str) and "${" in value:
            problem = f"the value {value!r} is computed when it is read, which the configuration of a run never needs"
            raise DataError(problem, "write the value itself", source=source, column=place)


def _uses(entries: Any) -> Iterator[Use]:
    """Yields what a configuration builds, starts or connects to."""
    for place, value in _walk(entries):
        if isinstance(value, Mapping) and "_target_" in value:
            target = value["_target_"]
            known = isinstance(target, str) and target in TARGETS
            yield Use(place, str(target), None if known else _unknown(target))
            if target == _GYM:
                yield from _imports_of_gym(place, value)
    collector = entries.get("collector")
    if isinstance(collector, Mapping):
        yield from _other_settings("collector.init", collector.get("init"), _RAY_INIT)
        yield from _other_settings("collector.resources", collector.get("resources"), _RAY_RESOURCES)


def _unknown(target: Any) -> str:
    near = get_close_matches(str(target), sorted(TARGETS), n=1)
    meant = f" (did you mean {near[0]}?)" if near else ""
    return f"_target_ {str(target)!r} is not one of this library's effects, envs, rewards and controllers{meant}"


def _imports_of_gym(place: str, node: Mapping) -> Iterator[Use]:
    """Gymnasium imports the module before the colon of a task's name, and TorchRL the one that ``backend`` names."""
    for inner, value in _walk(node):
        if isinstance(value, str) and (":" in value or inner == "backend"):
            yield Use(f"{place}.{inner}", value, f"the argument {value!r} of {_GYM} may import a module of that name")


def _other_settings(place: str, settings: Any, known: set[str]) -> Iterator[Use]:
    for key, value in settings.items() if isinstance(settings, Mapping) else ():
        if key not in known and value is not None:
            entry = f"{place}.{key}"
            yield Use(entry, entry, f"{key}={value!r} of Ray starts programs or connects to other machines")


def _walk(entries: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yields all values of nested mappings and lists with their places, the containers first."""
    yield place, entries
    if isinstance(entries, Mapping):
        for key, value in entries.items():
            yield from _walk(value, f"{place}.{key}" if place else str(key))
    elif isinstance(entries, list):
        for index, value in enumerate(entries):
            yield from _walk(value, f"{place}[{index}]")
