"""Contents of a report as plain data: the effects that a simulator lacks, their intervals, and the held-out errors."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from torchrl_h2o.data.audit import Audit
from torchrl_h2o.effects import Effect, quantity_name
from torchrl_h2o.residuals.between_logs import InLogs
from torchrl_h2o.residuals.progress import EFFECTS, OTHERS
from torchrl_h2o.residuals.report.errors import ErrorSummary, PredictionTable
from torchrl_h2o.residuals.report.mended_model import MendedModel
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.windows import RunError, ShownWindow
from torchrl_h2o.residuals.report.words import UNDECLARED, effect_name, effect_units, effect_words

NOTHING_MISSING, EXPLAINED = "nothing missing", "explained"
EXPLAINED_IN_PART, NOT_EXPLAINED = "explained in part", "not explained"
UNDECIDED = "undecided"  # nothing was found until the time for the search was up
VERDICTS = (NOTHING_MISSING, EXPLAINED, EXPLAINED_IN_PART, NOT_EXPLAINED, UNDECIDED)

Intervals = Mapping[str, tuple[float, float]]  # 95 % interval of each parameter by name, in the parameter's unit
Fitted = tuple[tuple[Effect, Intervals], ...]  # effects that were fitted together, each with its intervals


@dataclass(frozen=True)
class FoundEffect:
    """An effect that the simulator lacks.

    Args:
        effect: the effect at its fitted values.
        declared: True if it is an entry of the catalogue, False if it was derived from the residual.
        ci95: 95 % interval of each parameter by name, (low, high) in the parameter's unit.
        error_after: held-out error with the effects up to and including this one, in the summary's unit.
        words: description with units; by default the effect's own, without the simulator's names of sensors and
            actuators; an undeclared effect is marked.
        units: unit of each parameter by name, on the joints of this simulator; by default the effect's own.
        in_logs: each fitted parameter by name in each of several logs; empty for one log, and in files of earlier
            versions.
    """

    effect: Effect
    declared: bool
    ci95: Intervals
    error_after: float
    words: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    in_logs: Mapping[str, InLogs] = field(default_factory=dict)

    def __post_init__(self):
        if not self.units:
            object.__setattr__(self, "units", effect_units(self.effect))
        if not self.words:
            words = effect_words(self.effect)
            object.__setattr__(self, "words", words if self.declared else f"{UNDECLARED}: {words}")

    @property
    def name(self) -> str:
        """The effect's class and what it acts on: ``"BodyMass[torso]"``."""
        return effect_name(self.effect)

    @property
    def values(self) -> list[tuple[str, str, float, tuple[float, float]]]:
        """Name of the quantity, unit, value and interval of each parameter that was fitted or is not neutral."""
        rows = []
        for name, parameter in self.effect.parameters.items():
            if name in self.ci95 or parameter.value != parameter.neutral:
                unit = self.units.get(name, parameter.unit)
                ends = self.ci95.get(name, (float("nan"), float("nan")))
                rows.append((quantity_name(name, unit), unit, parameter.value, ends))
        return rows


@dataclass(frozen=True)
class RejectedEffect:
    """An effect that was fitted and not put in.

    Args:
        effect: the effect at its best fit.
        error_after: held-out error with this effect alone, in the summary's unit; not finite if it diverges.
        p_value: p-value of its gain on held-out data; None if no test was made.
        reason: reason why it was not put in, such as "explains no more than chance".
        words: description with units; by default the effect's own.
        units: unit of each parameter by name, on the joints of this simulator; by default the effect's own.
    """

    effect: Effect
    error_after: float
    p_value: float | None
    reason: str
    words: str = ""
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        if not self.units:
            object.__setattr__(self, "units", effect_units(self.effect))
        if not self.words:
            object.__setattr__(self, "words", effect_words(self.effect))

    @property
    def name(self) -> str:
        """The effect's class and what it acts on."""
        return effect_name(self.effect)


@dataclass(frozen=True)
class SearchStep:
    """A step of the search to a set of effects that predicts the data better, or as well and is more usual.

    Args:
        put_in: effects that were put in, in words.
        dropped: effects that were dropped, in words.
        gain: gain of the log density of the rows for fits and for selection, in nats for each reading.
        evidence: logarithm of the likelihood ratio for a gain above 0, paired over blocks of rows, in nats.
    """

    put_in: tuple[str, ...]
    dropped: tuple[str, ...]
    gain: float
    evidence: float


@dataclass(frozen=True)
class IndistinguishableGroup:
    """Effects that these data cannot tell apart.

    Args:
        effects: the effects, each at its best fit; the first is the one put in.
        errors: held-out error with each of them in place of the first, in the summary's unit.
        words: description of each effect with units; by default those of the effects.
        together: for each effect, all effects of the explanation with this one in the first's place, as they were
            fitted together; entries are empty if unknown, as in files of earlier versions. The other effects' values
            differ from those of the report, because they make up for the difference.

    Raises:
        ValueError: if the numbers of effects, errors and explanations differ.
    """

    effects: tuple[Effect, ...]
    errors: tuple[float, ...]
    words: tuple[str, ...] = ()
    together: tuple[Fitted, ...] = ()

    def __post_init__(self):
        if len(self.effects) != len(self.errors):
            raise ValueError(f"a group of {len(self.effects)} effects has {len(self.errors)} errors; give one for each")
        if not self.words:
            object.__setattr__(self, "words", tuple(map(effect_words, self.effects)))
        if not self.together:
            object.__setattr__(self, "together", ((),) * len(self.effects))
        if len(self.effects) != len(self.together):
            raise ValueError(
                f"a group of {len(self.effects)} effects has {len(self.together)} explanations; give one for each"
            )


@dataclass(frozen=True)
class OtherExplanation:
    """Another set of effects that explains the data as well as the effects found.

    Args:
        effects: the effects, fitted together.
        error: held-out error with them, in the summary's unit.
        words: description of each effect with units; by default those of the effects.
    """

    effects: tuple[Effect, ...]
    error: float
    words: tuple[str, ...] = ()

    def __post_init__(self):
        if not self.words:
            object.__setattr__(self, "words", tuple(map(effect_words, self.effects)))


@dataclass(frozen=True)
class Verdict:
    """What the held-out data say of an explanation.

    Args:
        kind: one of :data:`VERDICTS`.
        reasons: figures that the kind follows from, in words.
        recommended: whether the effects should be put into a simulator for training; in a report, False also if there
            are no effects or the search was not finished.
        where: when and at which states the unexplained part is largest; empty if nothing is unexplained.
        caveats: sentences on effects that may have another cause than the one they are named after, or another value.
        undetectable: where nothing is missing, effects that the data could not have shown, in words; one of each kind
            comes first.
        too_few: where nothing was found, an effect that lowers the held-out error, and how many rows there were to
            choose it by, too few for the tests; empty otherwise.

    Raises:
        ValueError: for an unknown kind.
    """

    kind: str
    reasons: tuple[str, ...] = ()
    recommended: bool = True
    where: str = ""
    caveats: tuple[str, ...] = ()
    undetectable: tuple[str, ...] = ()
    too_few: str = ""

    def __post_init__(self):
        if self.kind not in VERDICTS:
            raise ValueError(f"kind={self.kind!r}: choose {', '.join(VERDICTS)}")


@dataclass(frozen=True)
class Interval:
    """An interval of the data that no effect explains and that was excluded from fits and errors.

    Args:
        start: start time, in s.
        end: end time, in s.
        rows: number of transitions.
        size: largest residual, in multiples of the usual one.
        set_aside: reason, such as "a push from outside".
    """

    start: float
    end: float
    rows: int
    size: float
    set_aside: str


@dataclass(frozen=True)
class DataSummary:
    """Source of the measured data, and numbers of transitions: all, held out, and excluded by reason."""

    source: str
    transitions: int
    held_out: int
    left_out: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ReportContents:
    """Result of closing the loop, as plain data.

    Args:
        simulator: name of the simulator.
        data: the measured data.
        error: errors before and after; None if they could not be computed.
        found: effects that the simulator lacks, in the order in which they were put in.
        rejected: effects that were fitted and not put in.
        indistinguishable: effects that these data cannot tell apart.
        others: other sets of effects that explain the data as well, the most usual ones first.
        predictions: how well the held-out motion is predicted, in total and by joint; None if not computed.
        unexplained_intervals: intervals that were excluded as disturbed.
        steps: the steps of the search, in order.
        stop_test: description of the test by which the search stopped.
        wall_s: duration in s; None if not timed.
        made_by: commit, versions, CPU seconds and machine, see :func:`~torchrl_h2o.provenance.provenance`.
        conclusion: reason why there is no conclusion; None if effects were found or nothing is missing.
        verdict: what the held-out data say of the explanation; None for an unfinished report, and in files of earlier
            versions.
        failures: attempts that failed with an error, and why.
        unfinished: stage in which the run stopped or was when the report was written; None for a finished report.
        ended_in: stage in which the time for the search was up, or which did not begin for that; None if all ended.
        left_out: parts of the report that were not computed because the time was up, in words.
        audit: findings of the audit of the data; None if it was not audited.
        windows: worst, median and best window by the error with the effects, measured against simulated.
        runs: error of each run.
        mended_model: the MJCF file with the effects; None if none was asked for.
        trace: residual over time, for the pictures; None for a report without pictures. It is ignored by ``==``.

    Raises:
        ValueError: if effects are given together with a reason for no conclusion.
    """

    simulator: str
    data: DataSummary
    error: ErrorSummary | None = None
    found: tuple[FoundEffect, ...] = ()
    rejected: tuple[RejectedEffect, ...] = ()
    indistinguishable: tuple[IndistinguishableGroup, ...] = ()
    others: tuple[OtherExplanation, ...] = ()
    predictions: PredictionTable | None = None
    unexplained_intervals: tuple[Interval, ...] = ()
    steps: tuple[SearchStep, ...] = ()
    stop_test: str = ""
    wall_s: float | None = None
    made_by: Mapping[str, Any] = field(default_factory=dict)
    conclusion: str | None = None
    verdict: Verdict | None = None
    failures: tuple[str, ...] = ()
    unfinished: str | None = None
    ended_in: str | None = None
    left_out: tuple[str, ...] = ()
    audit: Audit | None = None
    windows: tuple[ShownWindow, ...] = ()
    runs: tuple[RunError, ...] = ()
    mended_model: MendedModel | None = None
    trace: ResidualTrace | None = field(default=None, compare=False)

    def __post_init__(self):
        if self.found and self.conclusion is not None:
            raise ValueError(
                f"a report with {len(self.found)} effects has a reason for no conclusion ({self.conclusion!r}); "
                "set conclusion=None, or leave out the effects"
            )
        if self.verdict is not None and self.verdict.recommended != self.recommended:
            object.__setattr__(self, "verdict", replace(self.verdict, recommended=self.recommended))

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects that mend the simulator, at their fitted values, in order."""
        return tuple(found.effect for found in self.found)

    @property
    def preliminary(self) -> bool:
        """Whether the time was up before all effects had been tried, so that others may replace those found."""
        return self.ended_in in (EFFECTS, OTHERS)

    @property
    def recommended(self) -> bool:
        """Whether there are effects, and the report recommends to put them into a simulator for training."""
        finished = self.unfinished is None and not self.preliminary
        return bool(self.found) and finished and (self.verdict is None or self.verdict.recommended)

    def why_not_recommended(self) -> str:
        """The reasons against putting the effects into a simulator, as one clause; empty if there are none."""
        if not self.found or self.recommended:
            return ""
        if self.unfinished is not None:
            return f"the search was not finished: it ended while {self.unfinished}"
        if self.preliminary:
            return f"the search was not finished: its time was up while it was {self.ended_in}"
        return "; ".join(self.verdict.reasons) if self.verdict is not None else ""
