"""Assign the columns of a log to the coordinates of a model."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import itemgetter
from typing import Literal

import numpy as np

from torchrl_h2o.data.readers.guess.contents import Contents
from torchrl_h2o.data.readers.guess.free_body import EULER, ORIENTATION, RATE
from torchrl_h2o.data.readers.guess.roles import Guess, kind_of_joint, words_of


@dataclass(frozen=True)
class Coordinates:
    """The coordinates and actuators of a model, for their names and units.

    Args:
        units: the unit of each coordinate by its name, positions before velocities; velocities end in ``_velocity``.
        actuators: the actuators' names.
        servos: what the commands of the actuators are, desired positions or velocities, if all are such servos.
        forces: whether all actuators push along an axis, as a propeller or a linear motor does.
        driven: the joint that each actuator moves; without those that move none, or several.
        ranges: lowest and highest position of the joints that have a range.
    """

    units: Mapping[str, str]
    actuators: Sequence[str]
    servos: Literal["position", "velocity"] | None = None
    forces: bool = False
    driven: Mapping[str, str] = field(default_factory=dict)
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

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
    found |= _between(positions, found, model) if not taken else {}
    found |= _by_kind(
        [name for name in positions if name not in found],
        [joint for joint in joints if joint not in found.values()],
        model,
        in_order=not found,
    )
    observed = ("position", "velocity", ORIENTATION, EULER, RATE)
    found |= {
        column.name: of_body[column.name] for column in columns if column.name in of_body and column.kind in observed
    }
    velocity_of = {position: velocity for velocity, position in pairs.items()}
    for position, joint in list(found.items()):
        if f"{joint}_velocity" in model.units:
            estimated = estimated_velocity(position, [column.name for column in columns])
            found[velocity_of.get(position, estimated)] = f"{joint}_velocity"
    return found


def _between(positions: Sequence[str], known: Mapping[str, str], model: Coordinates) -> dict[str, str]:
    """Return the joints of columns between those whose joints are known, if there are as many of both in between."""
    joints = [name for name in model.units if not name.endswith("_velocity")]
    places = sorted((positions.index(name), joints.index(joint)) for name, joint in known.items())
    if not places or places != sorted(places, key=itemgetter(1)):
        return {}
    ends = [(-1, -1), *places, (len(positions), len(joints))]
    found: dict[str, str] = {}
    for (column, joint), (next_column, next_joint) in pairwise(ends):
        if next_column - column == next_joint - joint:
            found |= zip(positions[column + 1 : next_column], joints[joint + 1 : next_joint], strict=True)
    return found if all(kind_of_joint(name) in (None, model.units[joint]) for name, joint in found.items()) else {}


def without_missing_joints(columns: Sequence[Guess], found: Mapping[str, str], model: Coordinates) -> list[Guess]:
    """The columns without those of joints that the model lacks, and the actions as those of its actuators.

    A position without a coordinate is that of a joint that the model lacks, if all its joints have a column. An action
    is that of the actuator that moves the joint of the position with the same name, but for the words that all
    actions, and all positions, have: ``action.elbow.pos`` and ``state.elbow.pos``. Other actions are left out if all
    actuators have one.

    Args:
        columns: the columns.
        found: the model's coordinate of each position and velocity.
        model: the coordinates of the model.
    """
    joints = {name for name in model.units if not name.endswith("_velocity")}
    lacks = {one.name for one in columns if one.kind == "position" and one.name not in found}
    lacks = lacks if joints <= set(found.values()) else set()
    of_actuator: dict[str, str] = {}
    if not any(one.of_model for one in columns if one.kind == "action"):
        positions, actions = (
            _own_words([one for one in columns if one.kind == kind]) for kind in ("position", "action")
        )
        joint_of = {words: found.get(name) for name, words in positions.items()}
        actuators = {joint: actuator for actuator, joint in model.driven.items()}
        of_joint = {name: actuators.get(joint_of.get(words) or "") for name, words in actions.items()}
        own = {name: actuator for name, actuator in of_joint.items() if actuator is not None}
        if sorted(own.values()) == sorted(model.actuators):
            of_actuator, lacks = own, lacks | (set(actions) - set(own))
    note = "of a joint that the model does not have"
    return [
        replace(one, kind="unknown", note=note)
        if one.name in lacks
        else replace(one, of_model=of_actuator.get(one.name, one.of_model))
        for one in columns
    ]


def _own_words(columns: Sequence[Guess]) -> dict[str, tuple[str, ...]]:
    """The words of each column's name that not all of them have."""
    words = {one.name: words_of(one.name) for one in columns}
    shared = set.intersection(*map(set, words.values())) if words else set()
    return {name: tuple(word for word in own if word not in shared) for name, own in words.items()}


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
