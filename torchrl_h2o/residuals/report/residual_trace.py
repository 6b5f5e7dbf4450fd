"""The one-step residual in time, before and after the effects were put in, for a report's pictures."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ResidualTrace:
    """The one-step residual in time.

    Args:
        time: (T,), in s, not decreasing: episodes stand one after another.
        names: the names of the n dimensions.
        units: their units.
        before: the residual without the effects, (T, n); NaN where there is none.
        after: the residual with them, (T, n).
        states: the measured state before each step, (T, n).
        held_out: which rows no fit has seen, (T,).

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
            raise ValueError(f"the trace has {n} names and {len(self.units)} units; give one for each")
        for name in ("before", "after", "states"):
            self._set(name, float, (rows, n))
        self._set("time", float, (rows,))
        self._set("held_out", bool, (rows,))
        if not np.all(np.diff(self.time) >= 0):
            raise ValueError("the trace's time decreases; let episodes stand one after another in time")

    def _set(self, name: str, dtype: type, shape: tuple[int, ...]) -> None:
        array = np.asarray(getattr(self, name), dtype=dtype)
        if array.shape != shape:
            raise ValueError(f"the trace's {name} has the shape {array.shape}; its times and names need {shape}")
        object.__setattr__(self, name, array)

    def thinned(self, points: int = 1500) -> "ResidualTrace":
        """At most so many rows, evenly spread."""
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
