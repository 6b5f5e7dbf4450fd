"""Scale the positions of a LeRobot dataset, which are shares of each servo's range, or degrees."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
from torchrl_h2o.data.readers.guess.roles import LARGEST_ANGLE, Guess

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
    calibration = contents.calibration
    if calibration is None:
        return list(columns)
    places = [one for one in columns if one.kind in ("position", "action")]
    numbers = [values for one in places if (values := contents.values.get(one.name)) is not None]
    largest = max((float(np.abs(values).max()) for values in numbers), default=0.0)
    if largest <= LARGEST_ANGLE:
        return [replace(one, unit="rad") if one in places else one for one in columns]
    if largest > _FULL:
        note = f"degrees, because some positions reach {largest:.4g}"
        return [replace(one, unit="deg", note=note) if one in places else one for one in columns]
    joint_of = {one.name: _joint(one, coordinates, model) for one in columns}
    return [_scaled(one, calibration, joint_of[one.name], model) if one in places else one for one in columns]


def _joint(column: Guess, coordinates: Mapping[str, str], model: Coordinates | None) -> str | None:
    if column.kind == "action":
        return None if model is None else model.driven.get(column.of_model or "")
    return coordinates.get(column.name)


def _scaled(column: Guess, calibration: Mapping[str, float], joint: str | None, model: Coordinates | None) -> Guess:
    whole = 100.0 if "gripper" in column.name else 200.0
    motors = [motor for motor in calibration if motor in column.name]
    if motors:
        turns = calibration[max(motors, key=len)]
        note = "a share of the range that the servo was calibrated to; check the zero and the direction"
        return replace(column, unit="rad", scale=2.0 * math.pi * turns / whole, note=note)
    if model is not None and joint is not None and joint in model.ranges:
        low, high = model.ranges[joint]
        scale, offset = (high - low) / whole, low if whole == 100.0 else 0.5 * (low + high)
        note = f"as a share of the range of {joint} in the model; check: {_ASK}"
        return replace(column, unit="rad", scale=scale, offset=offset, note=note)
    return replace(column, unit="deg", note=_ASK)
