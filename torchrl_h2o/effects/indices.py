"""Selects the entries of an action or an observation that an effect acts on, by their indices."""

from collections.abc import Iterable
from typing import Any

import numpy as np

Indices = tuple[int, ...] | None


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
