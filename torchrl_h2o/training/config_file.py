"""``config.yaml`` of a run's folder: written atomically, and read with the care that a file from elsewhere needs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import yaml
from omegaconf import DictConfig, OmegaConf

from torchrl_h2o.data import DataError
from torchrl_h2o.training.targets import require_known_targets
from torchrl_h2o.whole_file import write_text

FILE = "config.yaml"
LARGEST = 2**24  # bytes; a population's or a posterior's configuration has some ten thousand
DEEPEST = 40  # levels of nested lists and mappings; a run's configuration has at most eight
_EVENTS = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_LAYOUT = {"env": dict, "env.name": str, "env.make": dict, "env.simulator": list, "env.reality": list}
_REMEDY = "give the folder of a run, with the config.yaml that the run wrote"
# options that the first version did not have, with the values for what versions without them did
ADDED = {
    "gap_fix": None,
    "mend": None,
    "mended": None,
    "data_seconds": None,
    "ratio_estimator": "paper",
    "change_noise": 0.05,
    "ratio_weight_penalty": 2e-3,
    "ratio_logit_bound": None,
    "num_worlds": 1,
    "sim_capacity_min": 1,
    "n_steps": 1,
    "layer_norm": False,
    "num_qvalue_nets": 2,
    "lr_end_factor": 1.0,
    "compiled": False,
    "precision": "float32",
    "reward_offset": 0.0,
    "frames": 1,
    "action_history": 0,
    "overlap": False,
    "keep": "last",
}


def save_config(cfg: DictConfig, directory: Path) -> None:
    """Writes config.yaml."""
    write_text(directory / FILE, OmegaConf.to_yaml(cfg, resolve=True))


def load_config(
    directory: str | Path, *, trust: bool | str | Iterable[str] | None = None, typed: DictConfig | None = None
) -> DictConfig:
    """Reads the configuration of a run. It may come from somebody else, so what it can build is limited.

    Options that the version of the run did not have get the values for what that version did.

    Args:
        directory: the run's folder.
        trust: the option ``trust``, see :func:`~torchrl_h2o.training.targets.require_known_targets`.
        typed: the configuration of this call of the program, whose own names are allowed.

    Raises:
        FileNotFoundError: if the folder is not the folder of a run.
        torchrl_h2o.data.DataError: if the file is not the configuration of a run, or names something to build that
            neither this library nor the user knows.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> env = {"name": "mine", "make": {"_target_": "builtins.print"}, "simulator": [], "reality": []}
        >>> save_config(OmegaConf.create({"env": env}), folder)
        >>> load_config(folder)
        Traceback (most recent call last):
        ...
        torchrl_h2o.data.readers.error.DataError: ... _target_ 'builtins.print' is not ...
        >>> load_config(folder, trust=["builtins.print"]).env.name
        'mine'
    """
    saved = Path(directory) / FILE
    if not saved.exists():
        raise FileNotFoundError(f"{directory} is not the folder of a run: it has no {FILE}")
    cfg = _read(saved)
    entries = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=False))
    for name, kind in _LAYOUT.items():
        value = entries
        for key in name.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, kind):
            raise DataError(f"the entry is {value!r}, not a {kind.__name__}", _REMEDY, source=saved, column=name)
    require_known_targets(cfg, saved, trust=trust, typed=typed)
    cfg.update({name: value for name, value in ADDED.items() if name not in entries})
    if "trial_episodes" not in entries:  # earlier versions had one number for both
        cfg.trial_episodes = cfg.get("eval_episodes", 1)
    return cfg


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
    return cast(DictConfig, cfg)


def _require_plain(text: str, path: Path) -> None:
    """Raises DataError for aliases, which can stand for a billion entries in nine lines, and for deep nesting."""
    depth = 0
    for event in yaml.parse(text, Loader=_EVENTS):
        if isinstance(event, yaml.AliasEvent):
            line = event.start_mark.line + 1
            raise DataError("an alias, which a run never writes", _REMEDY, source=path, row=line)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise DataError(f"the entries are nested more than {DEEPEST} deep", _REMEDY, source=path)
