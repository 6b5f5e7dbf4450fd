"""Options of the benchmarks, ``name=value`` on the command line with the defaults of a script, and those of a run."""

import sys
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import torchrl_h2o.options  # noqa: F401  (makes the default values known to Hydra)

CONFIG = Path(__file__).parents[1] / "config"


def read_options(**defaults: Any) -> DictConfig:
    """Read ``name=value`` from the command line; lists as ``cases=[slow,nothing]``. A wrong option ends the script."""
    options = OmegaConf.create(defaults)
    OmegaConf.set_struct(options, True)
    try:
        return OmegaConf.merge(options, OmegaConf.from_cli())  # pyright: ignore[reportReturnType]
    except OmegaConfBaseException as error:
        named = error.full_key or "a wrong option"
        sys.exit(f"{named}: choose from {', '.join(f'{name}={value}' for name, value in defaults.items())}")


def run_options(*overrides: str) -> DictConfig:
    """The options of a run of ``recipes/train.py``, such as ``run_options("env=halfcheetah")``."""
    with hydra.initialize_config_dir(str(CONFIG), version_base=None):
        cfg = hydra.compose("any_method", ["hydra.searchpath=[pkg://torchrl_h2o.config]", *overrides])
    OmegaConf.set_struct(cfg, False)
    return cfg
