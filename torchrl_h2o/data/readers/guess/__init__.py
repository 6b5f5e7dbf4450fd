"""Guess the layout of a log from its header and values, as a YAML file that the user corrects."""

from torchrl_h2o.data.readers.guess.layout import guess_layout

__all__ = ["guess_layout"]
