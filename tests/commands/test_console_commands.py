"""The console commands: declared in the package, complete without a clone, and with the same help as the recipes."""

import subprocess
import sys
import tomllib
from importlib import import_module

import pytest

from tests.small_runs import ROOT

COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
RECIPES = {"close-the-loop": "close_the_loop.py", "h2o-evaluate": "evaluate.py"}


def test_each_recipe_with_a_command_has_it_declared():
    assert COMMANDS.keys() == RECIPES.keys()
    for target in COMMANDS.values():
        module, function = target.split(":")
        assert callable(getattr(import_module(module), function))


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_command_and_recipe_have_the_same_help(tmp_path, name):
    module, function = COMMANDS[name].split(":")
    as_command = ["-c", f"from {module} import {function}; {function}()", "--help"]
    as_recipe = [str(ROOT / "recipes" / RECIPES[name]), "--help"]
    printed = [
        subprocess.run([sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        for arguments in (as_command, as_recipe)
    ]
    assert printed[0] == printed[1]
    assert printed[0].count(f"  {name} ") >= 3  # at least three examples
