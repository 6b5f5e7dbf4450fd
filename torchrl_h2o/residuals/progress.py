"""The progress bar of closing the loop: the stage, an estimate of the time that is left, and the end of each part."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from tqdm import tqdm

from torchrl_h2o.effects import CatalogueEntry

# Stages in their order, with their usual shares of the time in per cent, rounded from four runs on HalfCheetah and on a
# double pendulum. A run in which nothing is missing, or in which the effects explain the data exactly, is shorter.
MEASURING = "measuring the residual"  # before the first stage
EFFECTS, OTHERS = "looking for effects", "looking for other explanations"
FORCES, NOISE, REPORT = "looking for undeclared forces", "looking for action noise", "reporting"
STAGES = {EFFECTS: 35.0, OTHERS: 30.0, FORCES: 20.0, NOISE: 5.0, REPORT: 10.0}

LAST_FIT = 0.1  # share of the time for the last fit of the effects found
REPORT_EVALUATIONS = 80.0  # duration of the judgement in one-step simulations of all rows, on the machines at hand
REPORT_LEAST, REPORT_MOST = 0.1, 0.35  # shares of the time between which that of the judgement lies

Computed = TypeVar("Computed")


class OutOfTimeError(Exception):
    """The time is up; the argument is the stage in which that happened."""


class LoopBar(tqdm):
    """Shows how much of the expected time has passed, in per cent, and what is being done.

    How many effects a search will find is not known before, so the bar moves by shares of what is left of a stage.

    Args:
        minutes: time for all stages, above 0; None for as long as they take. :meth:`check` raises
            :class:`OutOfTimeError` when the time of the present part is up: of the search, then of its last fit, then
            of the report. Until something is found, the search has all the time but the least share of the report.
        clock: returns the present time, in s.
        **options: options of ``tqdm``, such as ``disable=True`` or ``file``.

    Raises:
        ValueError: if ``minutes`` is not above 0.

    Examples:
        >>> with LoopBar(disable=True) as bar:
        ...     bar.stage("looking for effects")
        ...     bar.closer(0.5)
    """

    def __init__(
        self, *, minutes: float | None = None, clock: Callable[[], float] = time.monotonic, **options: Any
    ) -> None:
        if minutes is not None and not (isinstance(minutes, int | float) and minutes > 0.0):
            raise ValueError(f"minutes={minutes!r}: must be a number above 0, or None for as long as it takes")
        form = "{desc}{percentage:.0f}% |{bar}| {elapsed}, about {remaining} left{postfix}"
        options.setdefault("desc", MEASURING)
        options.setdefault("smoothing", 0.0)  # the time left follows from all the time passed; the last steps are tiny
        super().__init__(total=sum(STAGES.values()), bar_format=form, **options)
        self._end = 0.0
        self._stage = MEASURING
        self._seconds = math.inf if minutes is None else 60.0 * minutes
        self._clock = clock
        self._last = clock() + self._seconds
        self._for_report = self._for_short_report = REPORT_LEAST * self._seconds
        self._deadline = self._last if minutes is None else self._last - self._for_short_report
        self.left_out: list[str] = []  # parts of the report that were not computed because the time was up

    @property
    def time_is_up(self) -> bool:
        """Whether the time of the present part is up."""
        return self._clock() >= self._deadline

    def keep_for_report(self, evaluation: float) -> None:
        """Sets the time that the report needs where something was found.

        Args:
            evaluation: duration of a one-step simulation of all rows, in s.
        """
        if self._seconds < math.inf:
            share = min(max(REPORT_EVALUATIONS * evaluation / self._seconds, REPORT_LEAST), REPORT_MOST)
            self._for_report = share * self._seconds

    def has_result(self) -> None:
        """Ends the search earlier from now on, so that there is time to fit and to judge what it has found."""
        if self._seconds < math.inf:
            self._deadline = self._last - self._for_report - LAST_FIT * self._seconds

    def begin_last_fit(self, anything_found: bool) -> None:
        """Gives the last fit of the effects found the time that was kept for it, and the search for forces the rest."""
        self._deadline = self._last - (self._for_report if anything_found else self._for_short_report)

    def within_time(self, what: str, compute: Callable[[], Computed], otherwise: Computed) -> Computed:
        """Computes a part of the report, or returns ``otherwise`` and keeps ``what`` if the time is up before its end.

        Args:
            what: name of the part, in words.
            compute: computes it.
            otherwise: result if there is no time.
        """
        try:
            self.check()
            return compute()
        except OutOfTimeError:
            self.left_out.append(what)
            return otherwise

    def stage(self, name: str) -> None:
        """Begins a stage; the bar never moves back, and the report has all the time that is left.

        Raises:
            KeyError: for a name that is not in :data:`STAGES`.
        """
        share = STAGES[name]
        start = sum(list(STAGES.values())[: list(STAGES).index(name)])
        self._stage, self._end = name, max(self._end, start + share)
        if name == REPORT:
            self._deadline = self._last
        self.set_description(name, refresh=False)
        self.update(max(0.0, start - self.n))

    def closer(self, share: float) -> None:
        """Moves the bar by a share of what is left of the stage.

        Raises:
            OutOfTimeError: if the time is up.
        """
        self.check()
        self.update(share * max(0.0, self._end - self.n))

    def check(self) -> None:
        """Ends a computation whose time is up.

        Raises:
            OutOfTimeError: if the time is up.
        """
        if self.time_is_up:
            raise OutOfTimeError(self._stage)

    def show_found(self, entries: Sequence[CatalogueEntry]) -> None:
        """Names the effects found so far beside the bar."""
        self.set_postfix_str(", ".join(entry.name for entry in entries))

    def finish(self) -> None:
        """Moves the bar to the end."""
        self.update(max(0.0, self.total - self.n))
