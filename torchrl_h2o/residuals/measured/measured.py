"""Measured transitions as tracing reads them: float64 arrays, cut into runs, without the rows that say nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from tensordict import TensorDictBase

from torchrl_h2o.data import DataError
from torchrl_h2o.data.readers.ted import require_ted
from torchrl_h2o.residuals.simulation.simulation import Simulation

_ENOUGH = 3500  # windows: more make a fit slower and hardly better
MIN_TRANSITIONS = 200  # below, held-out data cannot tell an effect from chance


@dataclass(frozen=True, eq=False)
class Measured:
    """Measured transitions, in the order in which they happened.

    Args:
        observation: (T, n), before the action.
        action: (T, nu), as asked for.
        following: (T, n), the observation after the action.
        run: (T), the number of the unbroken run that a transition belongs to.
        time: (T), of the observation, in s, from the start of the data.
        usable: (T), whether a transition may be fitted and judged.
        held_out: (T), which transitions no fit sees.
        left_out: how many rows were left out, by reason.
        source: where they come from.
    """

    observation: np.ndarray
    action: np.ndarray
    following: np.ndarray
    run: np.ndarray
    time: np.ndarray
    usable: np.ndarray
    held_out: np.ndarray
    left_out: dict[str, int]
    source: str

    @classmethod
    def from_ted(
        cls,
        data: TensorDictBase,
        simulation: Simulation,
        *,
        source: str = "transitions",
        held_out: float = 0.3,
    ) -> Measured:
        """Transitions of a TED TensorDict, checked against the simulation.

        Args:
            data: batch size (T,), as the readers of :mod:`torchrl_h2o.data` return it.
            simulation: that they are to be compared with.
            source: what to call them in reports and errors.
            held_out: share of the transitions, the last ones, that no fit sees.

        Raises:
            DataError: if the data do not fit the simulation.
        """
        require_ted(data, source=source)
        observation, action = _float64(data["observation"]), _float64(data["action"])
        following = _float64(data["next", "observation"])
        _require_width(observation, simulation.state_map.names, "observation", source)
        _require_width(action, simulation.actuators, "action", source)
        ends = data["next", "done"].flatten().numpy()
        breaks = ends[:-1] | (following[:-1] != observation[1:]).any(1)
        run = np.concatenate([[0], np.cumsum(breaks)])
        clipped = simulation.state_map.clipped(observation) | simulation.state_map.clipped(following)
        judged = np.arange(len(run)) >= round((1.0 - held_out) * len(run))
        step = np.arange(len(run)) * simulation.control_step
        return cls(
            observation,
            action,
            following,
            run,
            _float64(data["time"]).flatten() if "time" in data.keys() else step,
            ~clipped,
            judged,
            {"a value at the end of its sensor's range": int(clipped.sum())} if clipped.any() else {},
            str(source),
        )

    def __len__(self) -> int:
        return len(self.observation)

    @property
    def runs(self) -> list[slice]:
        """The rows of each unbroken run."""
        edges = np.flatnonzero(np.diff(self.run)) + 1
        starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(self)]
        return [slice(start, stop) for start, stop in zip(starts, stops, strict=True)]

    def windows(self, horizon: int, stride: int = 1, *, held_out: bool | None = None) -> np.ndarray:
        """The first rows of all windows of so many usable transitions of one run.

        Args:
            horizon: transitions a window.
            stride: rows from one window to the next.
            held_out: True for windows of held-out transitions alone, False for windows without any, None for all.
        """
        good = self.usable.copy()
        if held_out is not None:
            good &= self.held_out == held_out
        starts = np.arange(0, len(self) - horizon + 1, stride)
        bad_before = np.concatenate([[0], np.cumsum(~good)])
        whole = bad_before[starts + horizon] == bad_before[starts]
        return starts[whole & (self.run[starts] == self.run[starts + horizon - 1])]

    def fitted(self, horizon: int = 1) -> np.ndarray:
        """The first rows of the windows that fits see: they do not overlap, and are enough, evenly spread."""
        return thinned(self.windows(horizon, horizon, held_out=False), _ENOUGH)

    def judged(self, horizon: int = 1) -> np.ndarray:
        """The first rows of the windows that no fit sees: they do not overlap, and are enough, evenly spread."""
        return thinned(self.windows(horizon, horizon, held_out=True), _ENOUGH)

    def part(self, rows: slice) -> Measured:
        """Some of the transitions, neighbours in time."""
        arrays = ("observation", "action", "following", "run", "time", "usable", "held_out")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    def without(self, rows: np.ndarray, reason: str) -> Measured:
        """The same data with more rows, a mask (T), left out for a reason."""
        left_out = dict(self.left_out)
        left_out[reason] = left_out.get(reason, 0) + int((rows & self.usable).sum())
        return replace(self, usable=self.usable & ~rows, left_out=left_out)

    def why_no_conclusion(self) -> str | None:
        """Why these data can say nothing of a simulator, None if they can."""
        if self.usable.sum() < MIN_TRANSITIONS:
            return (
                f"{int(self.usable.sum())} usable transitions are too few to tell an effect from chance; record at "
                f"least {MIN_TRANSITIONS}"
            )
        still = np.flatnonzero(np.ptp(self.observation[self.usable], axis=0) == 0.0)
        if len(still) == self.observation.shape[1]:
            return "nothing moves in these data; record some motion"
        if len(still):
            return (
                f"the observation's entries {', '.join(map(str, still))} never change, as of sensors that are off: "
                "what they say would be explained by effects that are not there; mend them or leave them out"
            )
        return None


def thinned(starts: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the windows, evenly spread."""
    return starts[np.unique(np.linspace(0, len(starts) - 1, min(most, len(starts))).round().astype(int))]


def _float64(tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _require_width(values: np.ndarray, names: Sequence[str], what: str, source: str) -> None:
    if values.shape[1] != len(names):
        raise DataError(
            f"the data have {values.shape[1]} entries, the simulator has {len(names)} ({', '.join(names)})",
            "give the simulator that the data belong to, or name the columns in the simulator's order",
            source=source,
            column=what,
        )
