"""Damaged config.yaml files: load_config returns a configuration of known names, or raises a short DataError."""

import pytest
import yaml
from hypothesis import given
from omegaconf import OmegaConf

from tests.fuzzing import changes_of_entries, damaged, few, many, outcome, text_damages, with_changed_entries
from tests.training.test_targets import CONFIG
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.targets import TARGETS

ENTRIES = CONFIG | {"num_cells": [64, 64], "mended": {"effects": [{"effect": "Gravity", "scale": 2.0}], "worlds": None}}
TEXT = yaml.safe_dump(ENTRIES).encode()


def targets_in(entries):
    if isinstance(entries, dict):
        yield from (entries["_target_"],) if "_target_" in entries else ()
        entries = list(entries.values())
    for entry in entries if isinstance(entries, list) else ():
        yield from targets_in(entry)


def assert_read_or_refused(folder, content):
    (folder / "config.yaml").write_bytes(content)
    cfg = outcome(load_config, folder)
    if cfg is not None:
        entries = OmegaConf.to_container(cfg, resolve=True)
        assert set(targets_in(entries)) <= TARGETS
        assert isinstance(entries["env"]["make"], dict)
        assert isinstance(entries["env"]["reality"], list)


@few
@given(changes=text_damages)
def test_a_damaged_configuration(tmp_path_factory, changes):
    assert_read_or_refused(tmp_path_factory.getbasetemp(), damaged(TEXT, changes))


@pytest.mark.slow
@many
@given(changes=text_damages)
def test_many_damaged_configurations(tmp_path_factory, changes):
    assert_read_or_refused(tmp_path_factory.getbasetemp(), damaged(TEXT, changes))


@pytest.mark.slow
@many
@given(changes=changes_of_entries)
def test_many_configurations_with_changed_entries(tmp_path_factory, changes):
    content = yaml.safe_dump(with_changed_entries(ENTRIES, changes)).encode(errors="surrogatepass")
    assert_read_or_refused(tmp_path_factory.getbasetemp(), content)
