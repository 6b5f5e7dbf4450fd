"""Columns of a joint that swings, and the layout that is guessed for them."""

import numpy as np
import yaml

from torchrl_h2o.data import LogColumns
from torchrl_h2o.data.readers.guess import guess_layout

TIME = 0.01 * np.arange(1500)
ANGLE = 4.0 * np.sin(TIME)
COMMAND = np.cos(7.0 * TIME)


def guessed(tmp_path, names: str, columns, model=None) -> str:
    np.savetxt(tmp_path / "log.csv", np.stack(columns, 1), delimiter=",", header=names, comments="")
    return guess_layout(tmp_path / "log.csv", model)


def renamed(text: str) -> dict[str, str]:
    """The coordinate of each observed column of a layout whose name differs."""
    coordinates = LogColumns.load(yaml.safe_load(text)).coordinates
    return {column: coordinate for column, coordinate in coordinates.items() if coordinate != column}
