"""Fast tests do not render."""

import pytest


@pytest.fixture(autouse=True)
def unfilmed(request, monkeypatch):
    if "slow" not in request.keywords:
        monkeypatch.setattr("torchrl_h2o.experiment.files.film_motion", lambda simulation, states, path: path.touch())
