"""Fixtures of the data tests."""

import logging

import pytest
from torchrl import torchrl_logger


@pytest.fixture
def log_messages():
    """Returns the messages that the library has logged."""
    messages = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    torchrl_logger.addHandler(handler)
    yield messages
    torchrl_logger.removeHandler(handler)
