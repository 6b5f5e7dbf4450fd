"""Recordings shared by the data tests: generated ones, and published ones if present."""

import logging
import os
from pathlib import Path

import pytest
from torchrl import torchrl_logger


@pytest.fixture
def shared_data():
    """Returns the folder of published recordings, which are not part of the repository."""
    beside = Path(__file__).parents[3] / "shared" / "data"
    folder = Path(os.environ.get("TORCHRL_H2O_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set TORCHRL_H2O_TEST_DATA")
    return folder


@pytest.fixture
def log_messages():
    """Returns the messages that the library has logged."""
    messages = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    torchrl_logger.addHandler(handler)
    yield messages
    torchrl_logger.removeHandler(handler)
