"""Writes a model with effects as an MJCF file, and tells which effects the file cannot hold."""

from torchrl_h2o.effects.mjcf.file import write_mjcf
from torchrl_h2o.effects.mjcf.holdable import NotHeld, put_into_spec

__all__ = ["NotHeld", "put_into_spec", "write_mjcf"]
