"""Selects what an effect acts on: bodies, joints and geoms by name patterns, actions and observations by index.

A pattern is a shell pattern on the element's name: ``"*thigh*"``. A pattern with a slash, ``"*thigh*/*"``, is matched
against ``body/name`` and selects elements by their body. ``"*"`` selects all. A pattern that equals an element's name
selects that element literally: ``"j[0]"`` selects the joint of that name.
"""

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

Names = str | tuple[str, ...]
Indices = tuple[int, ...] | None


def checked_names(value: Any) -> Names:
    """Returns one name pattern, or several as a tuple; raises ValueError for anything else."""
    if isinstance(value, str) and value:
        return value
    if isinstance(value, Iterable):
        patterns = tuple(value)
        if patterns and all(isinstance(pattern, str) and pattern for pattern in patterns):
            return patterns
    raise ValueError(f"{value!r} selects nothing by name; give one name pattern or several, or '*' for all")


def joints(spec: mujoco.MjSpec, patterns: Names) -> list[mujoco.MjsJoint]:
    """Returns the matching joints of a specification; raises ValueError if a pattern matches none."""
    return [spec.joints[i] for i in matching(_paths(spec.joints), patterns, "joint")]


def geoms(spec: mujoco.MjSpec, patterns: Names) -> list[mujoco.MjsGeom]:
    """Returns the matching geoms of a specification; raises ValueError if a pattern matches none."""
    return [spec.geoms[i] for i in matching(_paths(spec.geoms), patterns, "geom")]


def bodies(spec: mujoco.MjSpec, patterns: Names) -> list[mujoco.MjsBody]:
    """Returns the matching bodies except the world; raises ValueError if a pattern matches none."""
    moving = spec.bodies[1:]
    return [moving[i] for i in matching(_paths(moving), patterns, "body")]


def joint_dofs(model: mujoco.MjModel, patterns: Names) -> list[int]:
    """Returns the degrees of freedom of the matching joints of a compiled model."""
    views = [model.joint(i) for i in range(model.njnt)]
    paths = [(model.body(model.jnt_bodyid[joint.id]).name, joint.name) for joint in views]
    chosen = matching(paths, patterns, "joint")
    return [dof for dof in range(model.nv) if model.dof_jntid[dof] in chosen]


def body_ids(model: mujoco.MjModel, patterns: Names) -> list[int]:
    """Returns the ids of the matching bodies of a compiled model, except the world."""
    views = [model.body(i) for i in range(1, model.nbody)]
    paths = [(model.body(view.parentid[0]).name, view.name) for view in views]
    return [1 + i for i in matching(paths, patterns, "body")]


def geom_ids(model: mujoco.MjModel, patterns: Names) -> list[int]:
    """Returns the ids of the matching geoms of a compiled model."""
    views = [model.geom(i) for i in range(model.ngeom)]
    return matching([(model.body(view.bodyid[0]).name, view.name) for view in views], patterns, "geom")


def _paths(elements: Sequence) -> list[tuple[str, str]]:
    return [(element.parent.name, element.name) for element in elements]


def matching(paths: Sequence[tuple[str, str]], patterns: Names, kind: str) -> list[int]:
    """Returns the indices of the (body, name) pairs that match at least one of the patterns.

    Args:
        paths: the pairs.
        patterns: one pattern or several.
        kind: the kind of element, for the error message.

    Raises:
        ValueError: if a pattern matches none.
    """
    chosen = set()
    for pattern in (patterns,) if isinstance(patterns, str) else patterns:
        matches = {i for i, (body, name) in enumerate(paths) if pattern in (name, f"{body}/{name}")} or {
            i
            for i, (body, name) in enumerate(paths)
            if fnmatchcase(name, pattern) or ("/" in pattern and fnmatchcase(f"{body}/{name}", pattern))
        }
        if not matches:
            names = ", ".join(f"{body}/{name}" for body, name in paths) or f"no {kind} at all"
            raise ValueError(f"this model has no {kind} named '{pattern}'; it has {names}")
        chosen |= matches
    return sorted(chosen)


def checked_indices(value: Any) -> Indices:
    """Converts one index or several to a tuple and keeps None; raises ValueError for anything else."""
    if value is None:
        return None
    indices = tuple(value) if isinstance(value, Iterable) else (value,)
    if indices and all(isinstance(i, int | np.integer) and not isinstance(i, bool) and i >= 0 for i in indices):
        return tuple(int(index) for index in indices)
    raise ValueError(f"{value!r} selects nothing by index; give one index or several, counted from 0, or None for all")


def entry_mask(vector: np.ndarray, indices: Indices) -> np.ndarray:
    """Returns a mask of the chosen entries of the last dimension.

    Args:
        vector: an action or an observation, (..., n).
        indices: the chosen entries, None for all.

    Returns:
        A boolean mask, (n,).

    Raises:
        ValueError: if an index exceeds the size of the vector.
    """
    size = vector.shape[-1]
    if indices is None:
        return np.ones(size, dtype=bool)
    if not all(0 <= index < size for index in indices):
        raise ValueError(
            f"{indices} are not all indices of an action or observation of {size} entries; choose from 0 to {size - 1}"
        )
    mask = np.zeros(size, dtype=bool)
    mask[list(indices)] = True
    return mask
