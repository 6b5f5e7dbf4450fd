"""The progress bar of closing the loop: the stage, an estimate of the time that is left, and the end of that time."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

from torchrl_h2o.effects import CatalogueEntry

# Stages in their order, with their usual shares of the time in per cent, rounded from four runs on HalfCheetah and on a
# double pendulum. A run in which nothing is missing, or in which the effects explain the data exactly, is shorter.
MEASURING = "measuring the residual"  # before the first stage
EFFECTS, OTHERS = "looking for effects", "looking for other explanations"
FORCES, NOISE, REPORT = "looking for undeclared forces", "looking for action noise", "reporting"
STAGES = {EFFECTS: 35.0, OTHERS: 30.0, FORCES: 20.0, NOISE: 5.0, REPORT: 10.0}


class OutOfTimeError(Exception):
    """The time for the search is up; the argument is the stage in which that happened."""


class LoopBar(tqdm):
    """Shows how much of the expected time has passed, in per cent, and what is being done.

    How many effects a search will find is not known before, so the bar moves by shares of what is left of a stage.

    Args:
        minutes: time for all stages before the report, above 0, after which :meth:`check` raises
            :class:`OutOfTimeError`; None for as long as they take.
        **options: options of ``tqdm``, such as ``disable=True`` or ``file``.

    Raises:
        ValueError: if ``minutes`` is not above 0.

    Examples:
        >>> with LoopBar(disable=True) as bar:
        ...     bar.stage("looking for effects")
        ...     bar.closer(0.5)
    """

    def __init__(self, *, minutes: float | None = None, **options: Any) -> None:
        if minutes is not None and not minutes > 0.0:
            raise ValueError(f"minutes is the time for the search, above 0 or None, and not {minutes}")
        form = "{desc}{percentage:.0f}% |{bar}| {elapsed}, about {remaining} left{postfix}"
        options.setdefault("desc", MEASURING)
        options.setdefault("smoothing", 0.0)  # the time left follows from all the time passed; the last steps are tiny
        super().__init__(total=sum(STAGES.values()), bar_format=form, **options)
        self._end = 0.0
        self._stage = MEASURING
        self._deadline = math.inf if minutes is None else time.monotonic() + 60.0 * minutes

    @property
    def time_is_up(self) -> bool:
        """Whether no further step may begin; never during the report."""
        return self._stage != REPORT and time.monotonic() >= self._deadline

    def stage(self, name: str) -> None:
        """Begins a stage; the bar never moves back.

        Raises:
            KeyError: for a name that is not in :data:`STAGES`.
        """
        share = STAGES[name]
        start = sum(list(STAGES.values())[: list(STAGES).index(name)])
        self._stage, self._end = name, max(self._end, start + share)
        self.set_description(name, refresh=False)
        self.update(max(0.0, start - self.n))

    def closer(self, share: float) -> None:
        """Moves the bar by a share of what is left of the stage.

        Raises:
            OutOfTimeError: if the time for the search is up.
        """
        self.check()
        self.update(share * max(0.0, self._end - self.n))

    def check(self) -> None:
        """Ends a search whose time is up.

        Raises:
            OutOfTimeError: if the time for the search is up.
        """
        if self.time_is_up:
            raise OutOfTimeError(self._stage)

    def show_found(self, entries: Sequence[CatalogueEntry]) -> None:
        """Names the effects found so far beside the bar."""
        self.set_postfix_str(", ".join(entry.name for entry in entries))

    def finish(self) -> None:
        """Moves the bar to the end."""
        self.update(max(0.0, self.total - self.n))
