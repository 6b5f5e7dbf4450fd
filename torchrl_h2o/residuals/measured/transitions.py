"""Measured transitions as float64 arrays, cut into unbroken runs and into three parts: fit, selection and report."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, TypeVar, cast

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_h2o.data import DataError
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.data.readers.ted import require_ted
from torchrl_h2o.residuals.measured.begun_anew import BEGUN_ANEW, begun_anew
from torchrl_h2o.residuals.measured.moving_rows import moving_rows
from torchrl_h2o.residuals.simulation.simulation import Simulation

# usable transitions below which no conclusion is drawn: no test could distinguish an effect from chance
MIN_TRANSITIONS = 200
# share of the transitions that are not reported on, by which effects are chosen; a fifth of all by default
SELECTION_SHARE = 0.27
BORDER_MOVES = 0.1  # share of the transitions by which a border between two parts of the data moves to the end of a run
# ratio of an action's ranges (5th to 95th percentile) in two parts of several logs below which the logs differ in kind,
# such as free and driven motion
ALIKE_RANGES = 0.3
SETTLING_STEPS = 64  # control steps after which the observed coordinates determine the unobserved ones
# neighbouring windows that are kept together where there are unobserved coordinates, to share a simulation
WINDOWS_IN_BLOCK = 25

Result = TypeVar("Result")

HELD_OUT = 0.25  # share of the transitions on which errors are reported
MAX_WINDOWS = 3500  # largest number of windows in a judgement; more are slower and hardly more precise
REMEMBERED = 32  # results that are kept with the data


class Split(IntEnum):
    """The use of a transition: fit, selection or report.

    Errors on FIT and SELECTION are biased, because the parameters and the effects were chosen on these parts. Report
    errors on REPORT only.
    """

    FIT = 0
    """Parameters are fitted to it."""
    SELECTION = 1
    """Effects are chosen by it."""
    REPORT = 2
    """Errors are reported on it, after everything has been chosen."""


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
        split: (T), the :class:`Split` of each transition.
        left_out: number of excluded rows by reason.
        source: name of the data in reports and errors.
        estimated_std: (n), standard deviation of the errors of columns that were estimated from others, such as
            velocities from positions, and 0 for measured ones; None if all were measured.
        block: neighbouring windows that are kept or left out together.
        log: (T,), index of the log of each transition; None for one log.
    """

    observation: np.ndarray
    action: np.ndarray
    following: np.ndarray
    run: np.ndarray
    time: np.ndarray
    usable: np.ndarray
    split: np.ndarray
    left_out: dict[str, int]
    source: str
    estimated_std: np.ndarray | None = None
    block: int = 1
    log: np.ndarray | None = None
    _results: OrderedDict[tuple[Hashable, Simulation | None], Any] = field(
        default_factory=OrderedDict, init=False, repr=False
    )

    @classmethod
    def from_ted(
        cls,
        data: TensorDictBase,
        simulation: Simulation,
        *,
        source: str = "transitions",
        held_out: float | Collection[int] = HELD_OUT,
    ) -> Measured:
        """Converts a TED TensorDict, checks its widths against the simulation, and divides it into three parts.

        The parts are consecutive rows: those for fits, those for the selection of effects, those for the report. A
        border moves to the nearest end of a run if there is one near it. Several logs that differ in kind, such as free
        swings and driven ones, are each divided into rows for fits and rows for the selection; see :func:`divided`.

        Args:
            data: batch size (T,), as the readers of :mod:`torchrl_h2o.data` return it; with the entry ``"log"`` if the
                data are several logs: the index of each transition's log; and with ``"observation_std"`` (T, n) if
                columns were estimated from others: the standard deviation of their errors, 0 for measured ones.
            simulation: simulator that the data will be compared with.
            source: name of the data in reports and errors.
            held_out: share of the transitions, taken from the end, on which errors are reported; or the indices of
                the logs on which they are. Of the rest, ``SELECTION_SHARE`` is for the selection of effects.

        Raises:
            DataError: if observations or actions do not have the simulation's width, or no log is left for fits.
        """
        require_ted(data, source=source)
        observation, action = _float64(data["observation"]), _float64(data["action"])
        following = _float64(data["next", "observation"])
        _require_width(observation, simulation.state_map.names, "observation", source)
        _require_width(action, simulation.actuators, "action", source)
        ends = cast("torch.Tensor", data["next", "done"]).flatten().numpy()
        breaks = ends[:-1] | (following[:-1] != observation[1:]).any(1)
        anew = begun_anew(Log.of(data, simulation))
        # such a row is a run of its own
        run = np.concatenate([[0], np.cumsum(breaks | anew[:-1] | anew[1:])])
        clipped = simulation.state_map.clipped(observation) | simulation.state_map.clipped(following)
        logs = cast("torch.Tensor", data["log"]).flatten().numpy() if "log" in data.keys() else np.zeros(len(run), int)
        step = np.arange(len(run)) * simulation.control_step
        measured = cls(
            observation,
            action,
            following,
            run,
            _float64(data["time"]).flatten() if "time" in data.keys() else step,
            ~clipped,
            divided(run, logs, held_out, observation, action, source=str(source)),
            {"a value at the end of its sensor's range": int(clipped.sum())} if clipped.any() else {},
            str(source),
            _rms(_float64(data["observation_std"])) if "observation_std" in data.keys() else None,
            WINDOWS_IN_BLOCK if simulation.state_map.hidden else 1,
            logs,
        )
        if anew.any():
            measured = measured.without(anew, BEGUN_ANEW)
        if not simulation.state_map.hidden:
            return measured
        return measured.without(measured.run_beginnings(), "unobserved coordinates are not known yet")

    def __len__(self) -> int:
        return len(self.observation)

    @property
    def held_out(self) -> np.ndarray:
        """Mask, (T), of the transitions on which errors are reported."""
        return self.split == Split.REPORT

    @property
    def runs(self) -> list[slice]:
        """Rows of each unbroken run."""
        edges = np.flatnonzero(np.diff(self.run)) + 1
        starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(self)]
        return [slice(start, stop) for start, stop in zip(starts, stops, strict=True)]

    @property
    def shown_time(self) -> np.ndarray:
        """Time of each row, (T), in s, for plots: ``time``, but logs whose stamps begin anew follow one another."""
        steps = np.diff(self.time)
        anew = steps < 0.0
        usual = np.median(steps[~anew]) if (~anew).any() else 0.0
        return self.time[0] + np.concatenate([[0.0], np.cumsum(np.where(anew, usual, steps))])

    def run_beginnings(self) -> np.ndarray:
        """Mask, (T), of the first ``SETTLING_STEPS`` rows of each run, at most a quarter of the run."""
        rows = np.zeros(len(self), bool)
        for run in self.runs:
            rows[run.start : run.start + min(SETTLING_STEPS, (run.stop - run.start) // 4)] = True
        return rows

    def windows(self, horizon: int, stride: int = 1, *, split: Split | None = None) -> np.ndarray:
        """First rows, (W), of all windows that consist of usable transitions of a single run.

        Args:
            horizon: transitions per window.
            stride: rows from the start of one window to the next.
            split: windows of this part only; None for all, also those across the border between two parts.
        """
        good = self.usable.copy()
        if split is not None:
            good &= self.split == split
        starts = np.arange(0, len(self) - horizon + 1, stride)
        bad_before = np.concatenate([[0], np.cumsum(~good)])
        whole = bad_before[starts + horizon] == bad_before[starts]
        return starts[whole & (self.run[starts] == self.run[starts + horizon - 1])]

    def fitted(self, horizon: int = 1) -> np.ndarray:
        """First rows, (W), of the windows for fits: not overlapping, evenly thinned to ``MAX_WINDOWS``."""
        return self.spread_windows(Split.FIT, horizon)

    def reported_on(self, horizon: int = 1) -> np.ndarray:
        """First rows, (W), of the windows on which errors are reported, as :meth:`fitted`."""
        return self.spread_windows(Split.REPORT, horizon)

    def spread_windows(self, split: Split, horizon: int) -> np.ndarray:
        """First rows, (W), of a part's windows: not overlapping, evenly thinned to ``MAX_WINDOWS``."""
        return thinned(self.windows(horizon, horizon, split=split), MAX_WINDOWS, self.block)

    def part(self, rows: slice) -> Measured:
        """A contiguous piece of the transitions."""
        arrays = ("observation", "action", "following", "run", "time", "usable", "split")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    def without(self, rows: np.ndarray, reason: str) -> Measured:
        """The data with further rows, a mask (T), excluded and counted under a reason."""
        left_out = dict(self.left_out)
        left_out[reason] = left_out.get(reason, 0) + int((rows & self.usable).sum())
        return replace(self, usable=self.usable & ~rows, left_out=left_out)

    def remembered(self, what: Hashable, simulation: Simulation | None, compute: Callable[[], Result]) -> Result:
        """The result of a computation on these data with a simulation, which is kept for later calls.

        Args:
            what: name of the computation, and what else it depends on.
            simulation: the simulation; None if the result does not depend on it.
            compute: computes the result. Nobody may change the result afterwards.
        """
        key = (what, simulation)
        if key not in self._results:
            self._results[key] = compute()
        self._results.move_to_end(key)
        while len(self._results) > REMEMBERED:
            self._results.popitem(last=False)
        return self._results[key]

    def why_no_conclusion(self) -> str | None:
        """Reason why these data allow no conclusion about a simulator; None if a conclusion is possible."""
        if self.usable.sum() < MIN_TRANSITIONS:
            return (
                f"{int(self.usable.sum())} usable transitions are too few to tell an effect from chance; record at "
                f"least {MIN_TRANSITIONS}"
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


def divided(
    run: np.ndarray,
    logs: np.ndarray,
    held_out: float | Collection[int],
    observation: np.ndarray,
    action: np.ndarray,
    *,
    source: str = "transitions",
) -> np.ndarray:
    """Divides transitions into the parts for fits, for the selection of effects, and for the report.

    Whole logs are fitted or selected on if they are alike. If they are of different kinds, one kind alone could neither
    determine nor judge every effect: no motor shows its gain in logs of free swings. Each log is then divided at the
    row at which the share for fits of its rows in motion has passed. Rows at rest at its end are for fits.

    Args:
        run: (T), index of each transition's run, ascending.
        logs: (T), index of each transition's log.
        held_out: share of the transitions, from the end, on which errors are reported, or the indices of these logs.
        observation: (T, n), by which it is judged whether something moves.
        action: (T, nu), by whose ranges logs differ in kind.
        source: name of the data in errors.

    Returns:
        (T), the :class:`Split` of each transition.

    Raises:
        DataError: if the logs of the report are all logs, or none, or the share is none.

    Examples:
        >>> run = np.array([0, 0, 0, 0, 0, 1, 1, 2, 2, 2])
        >>> divided(run, np.zeros(10, int), 0.3, np.zeros((10, 1)), np.zeros((10, 1))).tolist()
        [0, 0, 0, 0, 0, 1, 1, 2, 2, 2]
    """
    split = np.full(len(run), Split.FIT)
    if isinstance(held_out, float | int):
        if not 0.0 <= held_out < 1.0:
            problem = f"held_out={held_out} is no share of the transitions"
            raise DataError(problem, "give a share below 1, such as 0.25, or the indices of logs", source=source)
        split[_border(run, 1.0 - held_out) :] = Split.REPORT
    else:
        split[np.isin(logs, list(held_out))] = Split.REPORT
        if (split == split[0]).all():
            raise DataError(
                "leave no log for fits, or none for the report" if len(split) else "are empty",
                "name in held_out some of the logs, not all of them",
                source=source,
            )
    rest = np.flatnonzero(split == Split.FIT)
    border = _border(run[rest], 1.0 - SELECTION_SHARE)
    if len(np.unique(logs[rest])) > 1 and not _alike(action[rest[:border]], action[rest[border:]]):
        moves = moving_rows(observation, run)
        for log in np.unique(logs[rest]):
            rows = rest[logs[rest] == log]
            passed = np.cumsum(moves[rows]) / max(1, moves[rows].sum())
            selected = (passed > 1.0 - SELECTION_SHARE) & ((passed < 1.0) | moves[rows])
            split[rows[selected]] = Split.SELECTION
    else:
        split[rest[border:]] = Split.SELECTION
    return split


def _alike(some: np.ndarray, others: np.ndarray) -> bool:
    """Whether each action has in some rows about the range that it has in the others."""
    if not len(some) or not len(others):
        return True
    ranges = [np.diff(np.quantile(rows, (0.05, 0.95), axis=0), axis=0)[0] for rows in (some, others)]
    low, high = np.sort(ranges, axis=0)
    return bool((low >= ALIKE_RANGES * high).all())


def _border(run: np.ndarray, share: float) -> int:
    """Row at a share of the rows, or the nearest first row of a run, if one is near enough."""
    wanted = round(share * len(run))
    firsts = np.flatnonzero(np.diff(run)) + 1
    if not 0 < wanted < len(run) or not len(firsts):
        return wanted
    nearest = int(firsts[np.abs(firsts - wanted).argmin()])
    return nearest if abs(nearest - wanted) <= BORDER_MOVES * len(run) else wanted


def thinned(starts: np.ndarray, most: int, block: int = 1) -> np.ndarray:
    """At most about ``most`` of the windows, evenly spread.

    Args:
        starts: (W), first rows of the windows.
        most: number of windows, rounded up to whole blocks.
        block: successive windows that are kept or left out together.
    """
    if len(starts) <= most:
        return starts
    count, kept = -(-len(starts) // block), -(-most // block)
    blocks = np.unique(np.linspace(0, count - 1, min(kept, count)).round().astype(int))
    chosen = (block * blocks[:, None] + np.arange(block)).ravel()
    return starts[chosen[chosen < len(starts)]]


def _float64(tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(0))


def _require_width(values: np.ndarray, names: Sequence[str], what: str, source: str) -> None:
    if values.shape[1] != len(names):
        raise DataError(
            f"the data have {values.shape[1]} entries, the simulator has {len(names)} ({', '.join(names)})",
            "choose the simulator that matches the data, or name the columns in the simulator's order",
            source=source,
            column=what,
        )
