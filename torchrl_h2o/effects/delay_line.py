"""Delays a signal by a number of steps that need not be whole: step by step, or a whole run at once."""

from collections import deque
from collections.abc import Callable

import numpy as np


def delay_line(steps: float, before: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function that delays its argument by a number of calls.

    Args:
        steps: the delay k + f, in steps; the fraction f mixes two neighbours, (1 - f) · v(t - k) +
            f · v(t - k - 1).
        before: returns the value to assume before the first one, given the first one.

    Returns:
        A function from a value (n,) to the delayed one, a new array.
    """
    whole, fraction = divmod(steps, 1.0)
    line = deque(maxlen=int(whole) + 2)

    def late(value: np.ndarray) -> np.ndarray:
        if not line:
            line.extend([before(value).copy()] * (int(whole) + 1))
        line.append(value.copy())
        return (1.0 - fraction) * line[1] + fraction * line[0]

    return late


def delayed(values: np.ndarray, steps: float, before: np.ndarray) -> np.ndarray:
    """Delays a whole run, as :func:`delay_line` does step by step.

    Args:
        values: the run (T, n).
        steps: the delay, in steps.
        before: the value to assume before the first one, (n,).

    Returns:
        The delayed run (T, n), a new array.
    """
    whole, fraction = divmod(steps, 1.0)
    held = np.broadcast_to(before, (int(whole) + 1, *values.shape[1:]))
    line = np.concatenate([held, values])
    return (1.0 - fraction) * line[1 : len(values) + 1] + fraction * line[: len(values)]


def advanced(values: np.ndarray, steps: float) -> np.ndarray:
    """Undoes the delay of a whole run by interpolating ahead; NaN beyond the end of the run.

    Args:
        values: the delayed run (T, n).
        steps: the delay, in steps.

    Returns:
        The run (T, n), a new array. Exact for delays of whole steps and for signals that are linear in time.
    """
    whole, fraction = divmod(steps, 1.0)
    ended = np.full((int(whole) + 1, *values.shape[1:]), np.nan)
    line = np.concatenate([values, ended])
    now, later = line[int(whole) :][: len(values)], line[int(whole) + 1 :][: len(values)]
    return (1.0 - fraction) * now + fraction * later if fraction else now.copy()
