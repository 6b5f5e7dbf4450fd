"""Configurations as the recipes and commands compose them, shared by the tests because Hydra takes 0.2 s for each."""

from functools import cache
from pathlib import Path

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

ROOT = Path(__file__).parents[1]
RECIPES, COMMANDS = ROOT / "recipes" / "config", ROOT / "torchrl_h2o" / "config"
GROUPS = {"env", "preset", "collector", "simulator"}  # options that choose a file


def composed(config: str, *overrides: str, folder: Path = RECIPES) -> DictConfig:
    """Composes a configuration; those that differ only in values of options come from one composition."""
    files = tuple(override for override in overrides if not _is_value(_parsed(override)))
    cfg = _composed(config, files, folder).copy()
    for override in map(_parsed, overrides):
        if _is_value(override):
            OmegaConf.update(cfg, override.key_or_group, override.value(), merge=True)
    return cfg


def _is_value(override: Override) -> bool:
    """Whether an override is NAME=VALUE of an option that exists and chooses no file."""
    return override.type.name == "CHANGE" and override.package is None and override.key_or_group not in GROUPS


@cache
def _parsed(override: str) -> Override:
    return OverridesParser.create().parse_override(override)


@cache
def _composed(config: str, overrides: tuple[str, ...], folder: Path) -> DictConfig:
    with hydra.initialize_config_dir(str(folder), version_base=None):
        return hydra.compose(config, list(overrides))
