"""The report of closing the loop: what the simulator lacks, how sure that is, and how much closer it now is.

Plain data. ``report_words`` puts it into words, ``report_json`` into a file, ``report_page`` onto a page.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.words import UNDECLARED, effect_name, effect_words, sentence


@dataclass(frozen=True)
class FoundEffect:
    """An effect that the simulator lacks.

    Args:
        effect: the effect at its fitted values.
        declared: whether it is an entry of the catalogue; else it was made from the residual.
        ci95: the 95 % interval of each parameter by name, (low, high) in the parameter's unit.
        error_after: the held-out error with the effects up to this one in, in the summary's unit.
        words: what the effect does, with units; by default those of the effect, without the names that a simulator
            gives to its sensors and actuators. One that no catalogue holds is marked so.
    """

    effect: Effect
    declared: bool
    ci95: Mapping[str, tuple[float, float]]
    error_after: float
    words: str = ""

    def __post_init__(self):
        if not self.words:
            words = effect_words(self.effect)
            object.__setattr__(self, "words", words if self.declared else f"{UNDECLARED}: {words}")

    @property
    def name(self) -> str:
        """The effect's class and what it acts on: ``"BodyMass[torso]"``."""
        return effect_name(self.effect)


@dataclass(frozen=True)
class RejectedEffect:
    """An effect that was tried and not put in.

    Args:
        effect: the effect at its best fit.
        error_after: the held-out error with it put in, in the summary's unit; not finite if it diverged.
        p_value: how likely chance alone explains as much, None where no test was made.
        reason: why it was not put in: "explains no more than chance".
        words: what the effect does, with units; by default those of the effect.
    """

    effect: Effect
    error_after: float
    p_value: float | None
    reason: str
    words: str = ""

    def __post_init__(self):
        if not self.words:
            object.__setattr__(self, "words", effect_words(self.effect))

    @property
    def name(self) -> str:
        """The effect's class and what it acts on."""
        return effect_name(self.effect)


@dataclass(frozen=True)
class IndistinguishableGroup:
    """Effects that these data cannot tell apart.

    Args:
        effects: the effects, each at its best fit; the first is the one put in.
        errors: the held-out error with each of them in place of the first, in the summary's unit.
        separated_by: which data would tell them apart.
        words: what each of them does, with units; by default those of the effects.

    Raises:
        ValueError: if there is not one error for each effect.
    """

    effects: tuple[Effect, ...]
    errors: tuple[float, ...]
    separated_by: str
    words: tuple[str, ...] = ()

    def __post_init__(self):
        if len(self.effects) != len(self.errors):
            raise ValueError(f"a group of {len(self.effects)} effects has {len(self.errors)} errors; give one for each")
        if not self.words:
            object.__setattr__(self, "words", tuple(map(effect_words, self.effects)))


@dataclass(frozen=True)
class DimensionError:
    """The held-out one-step error of one dimension.

    Args:
        name: of the dimension.
        unit: of the errors.
        before: without the effects.
        after: with all of them.
        floor: what the best possible model would leave, None where none was estimated.
        autocorrelation: of the residual that is left, from one transition to the next: about 0 where it is white, down
            to -0.5 where noise of the sensors is all of it, above 0 where the simulator still lacks something; None
            where it was not looked at.
    """

    name: str
    unit: str
    before: float
    after: float
    floor: float | None = None
    autocorrelation: float | None = None


@dataclass(frozen=True)
class HorizonError:
    """The held-out error some steps ahead, of each dimension by name, in the dimension's unit."""

    steps: int
    seconds: float
    before: Mapping[str, float]
    after: Mapping[str, float]


@dataclass(frozen=True)
class ErrorSummary:
    """The error on data that no fit has seen, before the effects were put in and after.

    Args:
        metric: what is measured: "held-out one-step RMSE, each dimension over its spread".
        unit: the unit of ``before``, ``after`` and ``floor``, ``"1"`` for a pure number.
        before: the error without the effects.
        after: the error with all of them.
        floor: the error that the best possible model would leave, None where none was estimated.
        per_dimension: the same for each dimension.
        horizons: the same some steps ahead.
    """

    metric: str
    unit: str
    before: float
    after: float
    floor: float | None = None
    per_dimension: tuple[DimensionError, ...] = ()
    horizons: tuple[HorizonError, ...] = ()


@dataclass(frozen=True)
class TwoSample:
    """Held-out AUC of a classifier, measured against simulated transitions; 0.5: no gap can be seen."""

    auc_before: float | None = None
    auc_after: float | None = None


@dataclass(frozen=True)
class Interval:
    """A stretch of the data that no effect explains and that was not fitted.

    Args:
        start: its start, in s.
        end: its end, in s.
        rows: how many transitions it holds.
        size: its residual, as a multiple of the usual one.
        set_aside: what was set aside: "a push from outside".
    """

    start: float
    end: float
    rows: int
    size: float
    set_aside: str


@dataclass(frozen=True)
class DataSummary:
    """The measured data: where they come from, how many were held out, how many left out and why."""

    source: str
    transitions: int
    held_out: int
    left_out: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Report:
    """What closing the loop found; ``DynamicsGap(*report.effects)`` mends the simulator.

    Args:
        simulator: the simulator's name.
        data: the measured data.
        error: the error before and after, None where it could not be measured.
        found: the effects that the simulator lacks, in the order in which they were put in.
        rejected: what was tried and not put in.
        indistinguishable: effects that these data cannot tell apart.
        two_sample: the gap as a classifier sees it, with no model of its cause.
        unexplained_intervals: what was set aside.
        stop_test: in words, the test by which the search stopped.
        wall_s: how long it took, in s, None where it was not timed.
        conclusion: why there is no conclusion; None where effects were found or nothing is missing.
        trace: the residual in time, None for a report without these pictures; two reports that differ
            in it alone are equal.

    Raises:
        ValueError: if there are effects and yet no conclusion.

    Examples:
        >>> from torchrl_h2o.effects import Gravity
        >>> found = FoundEffect(Gravity(0.5), declared=True, ci95={"scale": (0.49, 0.51)}, error_after=0.004)
        >>> report = Report(
        ...     simulator="pendulum.xml",
        ...     data=DataSummary("swing.csv", transitions=5000, held_out=1500),
        ...     error=ErrorSummary("held-out one-step RMSE", "rad/s", before=0.031, after=0.004, floor=0.003),
        ...     found=(found,),
        ... )
        >>> report.sentence()
        'Your simulator lacks: gravity × 0.5; one-step error 0.031 → 0.004 rad/s (−87 %), floor 0.003.'
        >>> report.effects
        (Gravity(scale=0.5),)
    """

    simulator: str
    data: DataSummary
    error: ErrorSummary | None = None
    found: tuple[FoundEffect, ...] = ()
    rejected: tuple[RejectedEffect, ...] = ()
    indistinguishable: tuple[IndistinguishableGroup, ...] = ()
    two_sample: TwoSample = TwoSample()
    unexplained_intervals: tuple[Interval, ...] = ()
    stop_test: str = ""
    wall_s: float | None = None
    conclusion: str | None = None
    trace: ResidualTrace | None = field(default=None, compare=False)

    def __post_init__(self):
        if self.found and self.conclusion is not None:
            raise ValueError(
                f"a report that names {len(self.found)} effects has no conclusion ({self.conclusion!r}); "
                "give conclusion=None, or no found effects"
            )

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that mend the simulator, at their fitted values, in order."""
        return tuple(found.effect for found in self.found)

    def sentence(self) -> str:
        """The whole report in one sentence."""
        return sentence(self)

    def to_json(self) -> dict[str, Any]:
        """The report as what ``report.json`` holds; numbers that are not finite become None."""
        from torchrl_h2o.residuals.report.json_file import report_to_json

        return report_to_json(self)

    def save(self, folder: str | Path) -> Path:
        """Writes ``report.json`` and ``report.html``.

        Args:
            folder: made where it does not exist.

        Returns:
            The path of ``report.json``.
        """
        from torchrl_h2o.residuals.report.json_file import write_report
        from torchrl_h2o.residuals.report.page import write_page

        path = write_report(self, folder)
        write_page(self, folder)
        return path

    @staticmethod
    def load(path: str | Path) -> "Report":
        """Reads a report.

        Args:
            path: ``report.json``, or the folder that holds it.

        Returns:
            The report, its trace thinned; a number that was not finite is None or NaN.

        Raises:
            DataError: if there is no such file, or it is no report.
        """
        from torchrl_h2o.residuals.report.json_file import read_report

        return read_report(path)
