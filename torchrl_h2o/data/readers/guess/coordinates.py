"""Assign the columns of a log to the coordinates of a model."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.free_body import ORIENTATION, RATE
from torchrl_h2o.data.readers.guess.roles import Guess, kind_of_joint


@dataclass(frozen=True)
class Coordinates:
    """The coordinates and actuators of a model, for their names and units.

    Args:
        units: the unit of each coordinate by its name, positions before velocities; velocities end in ``_velocity``.
        actuators: the actuators' names.
        servos: whether all actuators are position servos, whose commands are desired positions.
        forces: whether all actuators push along an axis, as a propeller or a linear motor does.
    """

    units: Mapping[str, str]
    actuators: Sequence[str]
    servos: bool = False
    forces: bool = False

    @property
    def quantities(self) -> dict[str, tuple[str, str | None]]:
        """Kind and unit of each name, None for actuators; a name of a joint and an actuator is the joint's."""
        actions: dict[str, tuple[str, str | None]] = dict.fromkeys(self.actuators, ("action", None))
        return actions | {
            name: ("velocity" if name.endswith("_velocity") else "position", unit) for name, unit in self.units.items()
        }


def coordinates_of(
    columns: Sequence[Guess], pairs: Mapping[str, str], model: Coordinates, of_body: Mapping[str, str]
) -> dict[str, str]:
    """Return the coordinate of each position and velocity, also of the velocities that are to be estimated."""
    taken = set(of_body.values())
    joints = [name for name in model.units if not name.endswith("_velocity") and name not in taken]
    positions = [column.name for column in columns if column.kind == "position" and column.name not in of_body]
    found: dict[str, str] = {}
    for joint in sorted(joints, key=len, reverse=True):
        like = [name for name in positions if joint.lower() in name.lower() and name not in found]
        if like:
            found[min(like, key=len)] = joint
    found |= _by_kind(
        [name for name in positions if name not in found],
        [joint for joint in joints if joint not in found.values()],
        model,
        in_order=not found,
    )
    observed = ("position", "velocity", ORIENTATION, RATE)
    found |= {
        column.name: of_body[column.name] for column in columns if column.name in of_body and column.kind in observed
    }
    velocity_of = {position: velocity for velocity, position in pairs.items()}
    for position, joint in list(found.items()):
        if f"{joint}_velocity" in model.units:
            estimated = estimated_velocity(position, [column.name for column in columns])
            found[velocity_of.get(position, estimated)] = f"{joint}_velocity"
    return found


def _by_kind(positions: Sequence[str], joints: Sequence[str], model: Coordinates, in_order: bool) -> dict[str, str]:
    """Return the joint of each position if there are as many: lengths slide, angles turn, the others are in order.

    If the names contradict that, the order decides, or nothing is returned without ``in_order``.
    """
    if len(positions) != len(joints):
        return {}
    units = [kind_of_joint(name) for name in positions]
    if any(units.count(unit) > [model.units[joint] for joint in joints].count(unit) for unit in ("rad", "m")):
        return dict(zip(positions, joints, strict=True)) if in_order else {}
    found: dict[str, str] = {}
    for known in (True, False):  # first those whose name tells their unit
        for name, unit in zip(positions, units, strict=True):
            if (unit is not None) == known:
                left = [joint for joint in joints if joint not in found.values()]
                found[name] = next(joint for joint in left if unit in (None, model.units[joint]))
    return found


def without_constants(columns: Sequence[Guess], contents: Contents, model: Coordinates) -> list[Guess]:
    """Positions and velocities that never change as columns to ignore, the last ones first, if there are too many."""
    kept, joints = list(columns), sum(not name.endswith("_velocity") for name in model.units)
    for kind in ("position", "velocity"):
        own = [index for index, column in enumerate(kept) if column.kind == kind]
        for index in reversed(own):
            values = contents.values.get(kept[index].name)
            if sum(column.kind == kind for column in kept) > joints and values is not None and np.ptp(values) == 0.0:
                kept[index] = replace(kept[index], kind="unknown", note="does not change")
    return kept


def estimated_velocity(position: str, taken: Collection[str]) -> str:
    """Name of the estimated velocity of a position, that no column of the file has."""
    name = f"{position}_velocity"
    return f"{name}_estimated" if name in taken else name
