"""A good log of the motored arm, and its simulation."""

import pytest

from tests.data.audit.recorded import arm, recording


@pytest.fixture(scope="module")
def good():
    return recording()


@pytest.fixture(scope="module")
def simulation():
    return arm()
