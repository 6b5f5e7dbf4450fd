"""Selects the entries of an action or an observation that an effect acts on, by their indices."""

import numpy as np

Indices = tuple[int, ...] | None


def entry_mask(vector: np.ndarray, indices: Indices) -> np.ndarray:
    """Marks the chosen entries of the last dimension.

    Args:
        vector: an action or an observation, (..., n).
        indices: the chosen entries, None for all.

    Returns:
        A mask, (n,).

    Raises:
        ValueError: if the vector has no such entry.
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
