"""Scale the positions of a LeRobot dataset, which are shares of each servo's range, or degrees."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
from torchrl_h2o.data.readers.guess.roles import Guess

_FULL = 100.5  # largest share of a range, in percent, with some tolerance
_ASK = (
    "-100 to 100 of the servo's range, or degrees? If it is a share, put the robot's calibration.json into the folder, "
    "and guess again"
)


def scaled(
    columns: Sequence[Guess], contents: Contents, coordinates: Mapping[str, str], model: Coordinates | None
) -> list[Guess]:
    """Return the columns with the size of their unit in rad, by the servos' calibration or the range in the model.

    LeRobot stores -100 to 100 of the range that a servo was calibrated to, 0 to 100 for a gripper, or degrees.

    Args:
        columns: the columns.
        contents: what the log says of itself, with the calibration.
        coordinates: the model's coordinate of each observed column.
        model: the coordinates of the model.
    """
    if contents.calibration is None:
        return list(columns)
    joint_of = {one.name: _joint(one, coordinates, model) for one in columns}
    return [_scaled(one, contents, joint_of[one.name], model) for one in columns]


def _joint(column: Guess, coordinates: Mapping[str, str], model: Coordinates | None) -> str | None:
    if column.kind == "action":
        return None if model is None else model.driven.get(column.of_model or "")
    return coordinates.get(column.name)


def _scaled(column: Guess, contents: Contents, joint: str | None, model: Coordinates | None) -> Guess:
    values = contents.values.get(column.name)
    if column.kind not in ("position", "action") or column.unit != "deg" or values is None:
        return column
    if np.abs(values).max() > _FULL:
        return replace(column, note=f"degrees, because some are beyond 100; {column.note}".rstrip("; "))
    whole = 100.0 if "gripper" in column.name else 200.0
    motors = [motor for motor in contents.calibration or () if motor in column.name]
    if motors:
        turns = (contents.calibration or {})[max(motors, key=len)]
        scale, note = 2.0 * math.pi * turns / whole, "a share of the range that the servo was calibrated to"
        return replace(column, unit="rad", scale=scale, note=note)
    if model is not None and joint is not None and joint in model.ranges:
        low, high = model.ranges[joint]
        scale, offset = (high - low) / whole, low if whole == 100.0 else 0.5 * (low + high)
        note = f"as a share of the range of {joint} in the model; check: {_ASK}"
        return replace(column, unit="rad", scale=scale, offset=offset, note=note)
    return replace(column, note=_ASK)
