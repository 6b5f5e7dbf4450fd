"""Modules that draw write their pictures without pyplot, whose backend is the user's."""

import runpy

import matplotlib
import pytest

from tests.small_runs import ROOT

DRAWING = [path for path in sorted((ROOT / "torchrl_h2o").rglob("*.py")) if "matplotlib" in path.read_text()]


@pytest.mark.parametrize("path", DRAWING, ids=lambda path: path.stem)
def test_the_backend_that_the_user_has_chosen_stays(monkeypatch, path):
    monkeypatch.setitem(matplotlib.rcParams, "backend", "svg")
    imported = runpy.run_path(str(path))  # as at the first import, and without a change of the module
    assert matplotlib.rcParams["backend"] == "svg"
    assert not {"plt", "pyplot"} & imported.keys()
