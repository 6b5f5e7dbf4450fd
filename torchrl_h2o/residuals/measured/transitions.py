"""Measured transitions as float64 arrays, cut into unbroken runs, with masks for usable and held-out rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_h2o.data import DataError
from torchrl_h2o.data.readers.ted import require_ted
from torchrl_h2o.residuals.settings import DEFAULTS, MeasuredSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation


@dataclass(frozen=True, eq=False)
class Measured:
    """Measured transitions in the order of their recording.

    Args:
        observation: (T, n), observation before the action.
        action: (T, nu), as commanded.
        following: (T, n), observation after the action.
        run: (T), index of the unbroken run that each transition belongs to.
        time: (T), time of the observation, in s from the start of the data.
        usable: (T), True for transitions that may be fitted and judged.
        held_out: (T), True for transitions that are reserved for the judgement.
        left_out: number of excluded rows by reason.
        source: name of the data in reports and errors.
        settings: sampling of windows, noise estimation and state estimation.
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
    settings: MeasuredSettings = DEFAULTS.measured

    @classmethod
    def from_ted(
        cls,
        data: TensorDictBase,
        simulation: Simulation,
        *,
        source: str = "transitions",
        held_out: float = 0.3,
        settings: MeasuredSettings = DEFAULTS.measured,
    ) -> Measured:
        """Converts a TED TensorDict and checks its widths against the simulation.

        Args:
            data: batch size (T,), as the readers of :mod:`torchrl_h2o.data` return it.
            simulation: simulator that the data will be compared with.
            source: name of the data in reports and errors.
            held_out: share of the transitions, taken from the end, that is reserved for the judgement.
            settings: sampling of windows, noise estimation and state estimation.

        Raises:
            DataError: if observations or actions do not have the simulation's width.
        """
        require_ted(data, source=source)
        observation, action = _float64(data["observation"]), _float64(data["action"])
        following = _float64(data["next", "observation"])
        _require_width(observation, simulation.state_map.names, "observation", source)
        _require_width(action, simulation.actuators, "action", source)
        ends = cast("torch.Tensor", data["next", "done"]).flatten().numpy()
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
            settings,
        )

    def __len__(self) -> int:
        return len(self.observation)

    @property
    def runs(self) -> list[slice]:
        """Rows of each unbroken run."""
        edges = np.flatnonzero(np.diff(self.run)) + 1
        starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(self)]
        return [slice(start, stop) for start, stop in zip(starts, stops, strict=True)]

    def windows(self, horizon: int, stride: int = 1, *, held_out: bool | None = None) -> np.ndarray:
        """First rows, (W), of all windows that consist of usable transitions of a single run.

        Args:
            horizon: transitions per window.
            stride: rows from the start of one window to the next.
            held_out: True for windows of held-out transitions only, False for windows without them, None for all.
        """
        good = self.usable.copy()
        if held_out is not None:
            good &= self.held_out == held_out
        starts = np.arange(0, len(self) - horizon + 1, stride)
        bad_before = np.concatenate([[0], np.cumsum(~good)])
        whole = bad_before[starts + horizon] == bad_before[starts]
        return starts[whole & (self.run[starts] == self.run[starts + horizon - 1])]

    def fitted(self, horizon: int = 1) -> np.ndarray:
        """First rows, (W), of the windows for fits: not overlapping, evenly thinned to ``settings.max_windows``."""
        return thinned(self.windows(horizon, horizon, held_out=False), self.settings.max_windows)

    def judged(self, horizon: int = 1) -> np.ndarray:
        """First rows, (W), of the held-out windows: not overlapping, evenly thinned to ``settings.max_windows``."""
        return thinned(self.windows(horizon, horizon, held_out=True), self.settings.max_windows)

    def part(self, rows: slice) -> Measured:
        """A contiguous part of the transitions."""
        arrays = ("observation", "action", "following", "run", "time", "usable", "held_out")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    def without(self, rows: np.ndarray, reason: str) -> Measured:
        """The data with further rows, a mask (T), excluded and counted under a reason."""
        left_out = dict(self.left_out)
        left_out[reason] = left_out.get(reason, 0) + int((rows & self.usable).sum())
        return replace(self, usable=self.usable & ~rows, left_out=left_out)

    def why_no_conclusion(self) -> str | None:
        """Reason why these data allow no conclusion about a simulator; None if a conclusion is possible."""
        if self.usable.sum() < self.settings.min_transitions:
            return (
                f"{int(self.usable.sum())} usable transitions are too few to tell an effect from chance; record at "
                f"least {self.settings.min_transitions}"
            )
        still = np.flatnonzero(np.ptp(self.observation[self.usable], axis=0) == 0.0)
        if len(still) == self.observation.shape[1]:
            return "no observed value changes in these data; record some motion"
        if len(still):
            return (
                f"the observation's entries {', '.join(map(str, still))} never change, as if their sensors were off: "
                "a fit would explain them by effects that do not exist; repair these sensors or leave the columns out"
            )
        return None


def thinned(starts: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of the windows, evenly spread."""
    return starts[np.unique(np.linspace(0, len(starts) - 1, min(most, len(starts))).round().astype(int))]


def _float64(tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _require_width(values: np.ndarray, names: Sequence[str], what: str, source: str) -> None:
    if values.shape[1] != len(names):
        raise DataError(
            f"the data have {values.shape[1]} entries, the simulator has {len(names)} ({', '.join(names)})",
            "choose the simulator that matches the data, or name the columns in the simulator's order",
            source=source,
            column=what,
        )
