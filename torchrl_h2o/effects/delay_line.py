"""A delay by any number of steps, also a fraction of one: step by step, or of a whole run at once."""

from collections import deque
from collections.abc import Callable

import numpy as np


def delay_line(steps: float, before: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """A function that returns what it was given some steps ago.

    Args:
        steps: the delay k + f, in steps; the fraction f mixes two neighbours, (1 - f) · v(t - k) +
            f · v(t - k - 1).
        before: from the first value to the one that the line holds before it.

    Returns:
        A function from a value (n,) to the delayed one, a new array.
    """
    whole, fraction = divmod(steps, 1.0)
    line = deque(maxlen=int(whole) + 2)

    def late(value: np.ndarray) -> np.ndarray:
        if not line:
            line.extend([before(value).copy()] * (line.maxlen - 1))
        line.append(value.copy())
        return (1.0 - fraction) * line[1] + fraction * line[0]

    return late


def delayed(values: np.ndarray, steps: float, before: np.ndarray) -> np.ndarray:
    """A whole run, delayed as by :func:`delay_line`.

    Args:
        values: the run (T, n).
        steps: the delay, in steps.
        before: what the line holds before the first value, (n,).

    Returns:
        The delayed run (T, n), a new array.
    """
    whole, fraction = divmod(steps, 1.0)
    held = np.broadcast_to(before, (int(whole) + 1, *values.shape[1:]))
    line = np.concatenate([held, values])
    return (1.0 - fraction) * line[1 : len(values) + 1] + fraction * line[: len(values)]


def advanced(values: np.ndarray, steps: float) -> np.ndarray:
    """A whole run, as it was before a delay: interpolated ahead, NaN where the run has ended.

    Args:
        values: the delayed run (T, n).
        steps: the delay, in steps.

    Returns:
        The run (T, n), a new array. Exact for whole steps, and for what changes evenly.
    """
    whole, fraction = divmod(steps, 1.0)
    ended = np.full((int(whole) + 1, *values.shape[1:]), np.nan)
    line = np.concatenate([values, ended])
    now, later = line[int(whole) :][: len(values)], line[int(whole) + 1 :][: len(values)]
    return (1.0 - fraction) * now + fraction * later if fraction else now.copy()
