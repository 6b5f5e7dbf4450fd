"""``config.yaml`` of a run's folder: written atomically, and read with the care that a file from elsewhere needs."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf

from torchrl_h2o.data import DataError
from torchrl_h2o.options import TrainOptions, check_options
from torchrl_h2o.training.targets import require_known_targets
from torchrl_h2o.whole_file import write_text

FILE = "config.yaml"
LARGEST = 2**24  # bytes; a population's or a posterior's configuration has some ten thousand
DEEPEST = 40  # levels of nested lists and mappings; a run's configuration has at most eight
_EVENTS = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_REMEDY = "give the folder of a run, with the config.yaml that the run wrote"


def save_config(cfg: DictConfig, directory: Path) -> None:
    """Writes config.yaml."""
    write_text(directory / FILE, OmegaConf.to_yaml(cfg, resolve=True))


def load_config(
    directory: str | Path, *, trust: bool | str | Iterable[str] | None = None, typed: DictConfig | None = None
) -> DictConfig:
    """Reads the configuration of a run. It may come from somebody else, so what it can build is limited.

    Args:
        directory: the run's folder.
        trust: the option ``trust``, see :func:`~torchrl_h2o.training.targets.require_known_targets`.
        typed: the configuration of this call of the program, whose own names are allowed.

    Returns:
        The configuration; options that it leaves out have their default values.

    Raises:
        FileNotFoundError: if the folder is not the folder of a run.
        torchrl_h2o.data.DataError: if the folder contains a link or a device, or the file is not the configuration of a
            run, or names something to build that neither this library nor the user knows.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> make = {"_target_": "builtins.print"}
        >>> env = {"name": "mine", "make": make, "simulator": [], "reality": [], "seconds_per_step": 0.1}
        >>> save_config(OmegaConf.create({"env": env}), folder)
        >>> load_config(folder)
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: ... _target_ 'builtins.print' is not ...
        >>> load_config(folder, trust=["builtins.print"]).env.name
        'mine'
    """
    saved = Path(directory) / FILE
    if not os.path.lexists(saved):
        raise FileNotFoundError(f"{directory} is not the folder of a run: it has no {FILE}")
    require_plain_files(directory)
    cfg = _read(saved)
    require_known_targets(cfg, saved, trust=trust, typed=typed)
    try:
        check_options(cfg, TrainOptions, saved=True)
    except ValueError as error:
        raise DataError(str(error), _REMEDY, source=saved) from error
    for name, default in TrainOptions.model_construct().model_dump(by_alias=True).items():
        if name not in cfg:
            cfg[name] = default
    return cfg


def require_plain_files(directory: str | Path) -> None:
    """Requires a run's folder to contain nothing but files and folders.

    Through a link the run would write elsewhere, and reading a device or a pipe may never end. The folder itself may be
    a link.

    Raises:
        torchrl_h2o.data.DataError: for the first link, pipe, socket or device.
    """
    for folder, folders, files in os.walk(directory):
        for name in (*folders, *files):
            path = Path(folder, name)
            mode = path.lstat().st_mode
            if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
                kind = "a link" if stat.S_ISLNK(mode) else "neither a file nor a folder"
                raise DataError(f"this is {kind}", "copy the run's folder without it", source=path)


def _read(path: Path) -> DictConfig:
    try:
        if (size := path.stat().st_size) > LARGEST:
            raise DataError(f"the file has {size} bytes, more than {LARGEST}", _REMEDY, source=path)
        text = path.read_text(encoding="utf-8")
        _require_plain(text, path)
        cfg = OmegaConf.create(text)
    except DataError:
        raise
    except Exception as error:  # yaml and omegaconf raise errors of all kinds for damaged files
        raise DataError(f"the file cannot be read as YAML: {error}", _REMEDY, source=path) from error
    if not isinstance(cfg, DictConfig):
        raise DataError("the file is not a mapping", _REMEDY, source=path)
    return cfg


def _require_plain(text: str, path: Path) -> None:
    """Raises DataError for what a run never writes, and what could stand for anything or for a billion entries.

    These are values that are computed when they are read (``${oc.env:HOME}``), aliases, and deep nesting.
    """
    depth = 0
    for event in yaml.parse(text, Loader=_EVENTS):
        if isinstance(event, yaml.AliasEvent):
            line = event.start_mark.line + 1
            raise DataError("an alias, which a run never writes", _REMEDY, source=path, row=line)
        if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
            problem = f"the value {event.value!r} is computed when it is read, which a run never needs"
            raise DataError(problem, "write the value itself", source=path, row=event.start_mark.line + 1)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise DataError(f"the entries are nested more than {DEEPEST} deep", _REMEDY, source=path)
