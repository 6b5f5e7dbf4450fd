"""The one-step residual over time, before and after the effects are put in, for the pictures of a report."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ResidualTrace:
    """The one-step residual over time.

    Args:
        time: (T,), in s, not decreasing; episodes follow one another.
        names: names of the n dimensions.
        units: their units.
        before: (T, n), residual without the effects; NaN where it is not defined.
        after: (T, n), residual with the effects.
        states: (T, n), measured state before each step.
        held_out: (T,), True for rows that no fit has used.

    Raises:
        ValueError: if the shapes do not agree or time decreases.

    Examples:
        >>> one = np.zeros((2000, 1))
        >>> trace = ResidualTrace(np.arange(2000) / 100, ("v",), ("m/s",), one, one, one, np.zeros(2000, bool))
        >>> trace.thinned(500).before.shape
        (500, 1)
    """

    time: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    states: np.ndarray
    held_out: np.ndarray

    def __post_init__(self):
        rows, n = len(self.time), len(self.names)
        if len(self.units) != n:
            raise ValueError(f"the trace has {n} names and {len(self.units)} units; give one unit per name")
        for name in ("before", "after", "states"):
            self._set(name, float, (rows, n))
        self._set("time", float, (rows,))
        self._set("held_out", bool, (rows,))
        if not np.all(np.diff(self.time) >= 0):
            raise ValueError("the trace's time decreases; shift the episodes so that they follow one another")

    def _set(self, name: str, dtype: type, shape: tuple[int, ...]) -> None:
        array = np.asarray(getattr(self, name), dtype=dtype)
        if array.shape != shape:
            raise ValueError(f"the trace's {name} has the shape {array.shape}; its times and names require {shape}")
        object.__setattr__(self, name, array)

    def thinned(self, points: int = 1500) -> "ResidualTrace":
        """The trace reduced to at most ``points`` evenly spread rows."""
        rows = np.unique(np.linspace(0, len(self.time) - 1, min(points, len(self.time))).round().astype(int))
        return ResidualTrace(
            time=self.time[rows],
            names=self.names,
            units=self.units,
            before=self.before[rows],
            after=self.after[rows],
            states=self.states[rows],
            held_out=self.held_out[rows],
        )
