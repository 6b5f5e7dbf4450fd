"""Judges an explanation on held-out data: errors, predictions, alternatives, remaining disturbances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from torchrl_h2o.effects import CatalogueEntry, Effect, is_negligible
from torchrl_h2o.residuals.evidence import Evidence
from torchrl_h2o.residuals.explanation import Alternative, Explanation, Tried, adds_noise
from torchrl_h2o.residuals.judge.caveats import undetermined_values
from torchrl_h2o.residuals.judge.held_out_error import error_summary, overall_error, with_floor, with_horizons
from torchrl_h2o.residuals.judge.prediction_table import Predicted, predicted
from torchrl_h2o.residuals.judge.run_errors import run_errors
from torchrl_h2o.residuals.judge.shown_windows import shown_windows
from torchrl_h2o.residuals.judge.verdict import reach_verdict
from torchrl_h2o.residuals.measured.outside import OutsideInterval, still_outside, without_intervals
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured, Split
from torchrl_h2o.residuals.progress import REPORT, LoopBar, OutOfTimeError
from torchrl_h2o.residuals.report.contents import NOT_EXPLAINED, NOTHING_MISSING, UNDECIDED, Verdict
from torchrl_h2o.residuals.report.errors import ErrorSummary, PredictionTable
from torchrl_h2o.residuals.report.residual_trace import ResidualTrace
from torchrl_h2o.residuals.report.windows import RunError, ShownWindow
from torchrl_h2o.residuals.report.words import effect_words
from torchrl_h2o.residuals.simulation.simulation import Simulation

MAX_REJECTED = 30  # largest number of rejected effects in the report
# share of the held-out error that an effect which was not put in must leave at most to be named all the same
LOWERS_MUCH = 0.8


@dataclass(frozen=True, eq=False)
class Alternatives:
    """An effect and the alternatives that explain the data equally well in its place.

    Args:
        effects: the effects; the first is the one put in.
        errors: held-out error with each of them.
    """

    effects: tuple[Effect, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Judgement:
    """Held-out figures of an explanation.

    Args:
        measured: the data, without the intervals of remaining disturbances.
        disturbed: the remaining disturbances.
        error: errors before and after; None if there was no time to compute them.
        errors_after: for each part, the error with the effects up to and including it.
        rejected: attempts that are not part of the explanation, and the error with each of them alone.
        alternatives: an entry for each part that has alternatives.
        predictions: how well the held-out motion is predicted, in total and by joint; None without enough windows.
        trace: the residual over time; None if there was no time.
        windows: worst, median and best window, measured against simulated.
        runs: error of each run.
        verdict: what these figures say.
        failures: attempts that failed with an error, and why.
        others: each other set of effects that explains the data as well, with its error.
        left_out: parts that were not computed because the time was up, in words.
    """

    measured: Measured
    disturbed: tuple[OutsideInterval, ...]
    error: ErrorSummary | None
    errors_after: tuple[float, ...]
    rejected: tuple[tuple[Tried, float], ...]
    alternatives: tuple[Alternatives, ...]
    predictions: PredictionTable | None
    trace: ResidualTrace | None
    windows: tuple[ShownWindow, ...]
    runs: tuple[RunError, ...]
    verdict: Verdict
    failures: tuple[str, ...] = ()
    others: tuple[tuple[tuple[Effect, ...], float], ...] = ()
    left_out: tuple[str, ...] = ()


def judge(
    evidence: Evidence,
    explanation: Explanation,
    catalogue: Sequence[CatalogueEntry] = (),
    *,
    progress: LoopBar,
    seed: int = 0,
) -> Judgement:
    """Judges an explanation on data that no fit has used.

    Args:
        evidence: the simulator without the effects, and the data.
        explanation: the effects.
        catalogue: the effects that were tried; where nothing is missing, the verdict names those of a usual size that
            the data could not have shown.
        progress: the time for the report; what it does not allow is left out and named in ``left_out``.
        seed: seed of the network that learns from what the effects leave.

    Returns:
        The held-out figures and the verdict.
    """
    simulation, effects, optional = evidence.simulation, explanation.effects, progress.within_time
    mended = simulation.with_effects(*_without_noise(effects))
    disturbed = optional("disturbances", lambda: _remaining_disturbances(evidence, explanation), [])
    measured = without_intervals(evidence.measured, disturbed)
    error = optional("the errors", lambda: error_summary(simulation, mended, measured), None)
    steps = _shown_steps(error, simulation)
    predictions = optional(
        "the table of predictions",
        lambda: None if error is None else predicted(simulation, mended, measured, steps or 1, seed=seed),
        None,
    )
    verdict = optional(
        "the verdict",
        lambda: _verdict(simulation, mended, measured, explanation, error, predictions),
        Verdict(UNDECIDED, ("the time was up before a verdict was reached",), recommended=False),
    )
    if verdict.kind == NOTHING_MISSING and (explanation.ended_in is not None or progress.left_out):
        verdict = replace(verdict, kind=UNDECIDED)
    if verdict.kind == NOTHING_MISSING and not explanation.failures:
        unseen = tuple(effect_words(effect, simulation.names) for effect in explanation.unseen)
        verdict = replace(verdict, undetectable=unseen)
    details = _details(simulation, mended, measured, explanation, error, progress)
    if verdict.kind == NOT_EXPLAINED and not effects and explanation.ended_in is None and error is not None:
        verdict = replace(verdict, too_few=too_few_rows(simulation, measured, details["rejected"], error))
    return Judgement(
        measured=measured,
        disturbed=tuple(disturbed),
        predictions=None if predictions is None else predictions.table,
        verdict=verdict,
        left_out=tuple(progress.left_out),
        **details,
    )


def _details(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    explanation: Explanation,
    error: ErrorSummary | None,
    progress: LoopBar,
) -> dict[str, Any]:
    """The fields of a judgement that the verdict does not need, the most useful ones first, as far as there is time."""
    effects, optional = explanation.effects, progress.within_time
    unknown = (math.nan,) * len(effects)
    errors_after = optional("errors of each effect", lambda: _errors_after(simulation, effects, measured), unknown)
    alternatives = optional("errors of alternatives", lambda: _all_alternatives(simulation, measured, explanation), ())
    others = optional("other sets", lambda: _others(simulation, measured, explanation), ())
    if error is not None:
        error = optional("errors ahead", partial(with_horizons, error, simulation, mended, measured), error)
        error = optional("the floor", partial(with_floor, error, mended, measured), error)
    steps = _shown_steps(error, simulation)
    windows = optional("windows", lambda: shown_windows(simulation, mended, measured, steps), ())
    runs = optional("errors by run", lambda: run_errors(simulation, mended, measured), ())
    trace = optional("the residual over time", lambda: _residual_trace(simulation, mended, measured), None)
    rejected, failures = optional(
        "errors of rejected effects", lambda: _rejected(simulation, measured, explanation), ((), ())
    )
    return {
        "error": error,
        "errors_after": errors_after,
        "alternatives": alternatives,
        "others": others,
        "windows": windows,
        "runs": runs,
        "trace": trace,
        "rejected": rejected,
        "failures": (*explanation.failures, *failures),
    }


def _verdict(
    simulation: Simulation,
    mended: Simulation,
    measured: Measured,
    explanation: Explanation,
    error: ErrorSummary | None,
    predictions: Predicted | None,
) -> Verdict:
    if error is None:
        raise OutOfTimeError(REPORT)  # the verdict is read from the errors
    undetermined = undetermined_values(explanation.parts, simulation.names)
    effects = explanation.effects
    return reach_verdict(simulation, mended, measured, effects, error, predictions, undetermined)


def _errors_after(simulation: Simulation, effects: tuple[Effect, ...], measured: Measured) -> tuple[float, ...]:
    """For each effect, the error with the effects up to and including it."""
    counts = range(1, len(effects) + 1)
    return tuple(overall_error(simulation.with_effects(*_without_noise(effects[:n])), measured) for n in counts)


def too_few_rows(
    simulation: Simulation,
    measured: Measured,
    rejected: Sequence[tuple[Tried, float]],
    error: ErrorSummary,
) -> str:
    """An effect that was not put in although it clearly lowers the error on data that chose nothing, in words.

    The catalogue may then explain what is missing, and only the part of the data by which effects are chosen is too
    short for the tests. It has to predict that part better as well: otherwise the two contradict each other.

    Args:
        simulation: the simulator without effects.
        measured: the data.
        rejected: attempts, and the error with each of them alone.
        error: the error without them.
    """
    rejected = [(attempt, after) for attempt, after in rejected if attempt.evidence > 0.0]
    attempt, after = min(rejected, key=lambda pair: (np.isnan(pair[1]), pair[1]), default=(None, math.nan))
    if attempt is None or not after < LOWERS_MUCH * error.before:
        return ""
    rows = int((measured.split == Split.SELECTION).sum())
    words = effect_words(attempt.effect, simulation.names)
    less = f"{1.0 - after / error.before:.0%}"
    return (
        f"For example, {words} lowers the error by {less} on the rows kept aside for this report, but the {rows} rows "
        "by which effects are chosen are too few, or move too little, to exclude chance: record more, or give more logs"
    )


def _shown_steps(error: ErrorSummary | None, simulation: Simulation) -> int | None:
    """Control steps of the windows that the report shows: those of its sentence."""
    return None if error is None or error.headline is None else round(error.headline.seconds / simulation.control_step)


def _remaining_disturbances(evidence: Evidence, explanation: Explanation) -> list[OutsideInterval]:
    """The suspected disturbances that the mended simulator does not explain."""
    mended = evidence.simulation.with_effects(*explanation.effects)
    return still_outside(evidence.suspected, mended, evidence.measured)


def _without_noise(effects: tuple[Effect, ...]) -> list[Effect]:
    return [effect for effect in effects if not adds_noise(effect)]


def _rejected(
    simulation: Simulation, measured: Measured, explanation: Explanation
) -> tuple[tuple[tuple[Tried, float], ...], tuple[str, ...]]:
    """The attempts that are not part of the explanation, with the error of each alone; and those that failed."""
    sized = [attempt for attempt in explanation.tried if not is_negligible(attempt.effect, attempt.entry.trials)]
    listed = sized[:MAX_REJECTED]
    rejected, failures = [], []
    for attempt in listed:
        try:
            error = overall_error(simulation.with_effects(attempt.effect), measured)
        except (ValueError, np.linalg.LinAlgError) as reason:  # it was fitted beside other effects, and needs them
            error = math.nan
            words = effect_words(attempt.effect, simulation.names)
            failures.append(f"{words} cannot be put into the model alone: {reason}")
        rejected.append((attempt, error))
    return tuple(rejected), tuple(failures)


def _all_alternatives(simulation: Simulation, measured: Measured, explanation: Explanation) -> tuple[Alternatives, ...]:
    return tuple(
        _alternatives(simulation, measured, explanation.effects, index, part.alike)
        for index, part in enumerate(explanation.parts)
        if part.alike
    )


def _alternatives(
    simulation: Simulation,
    measured: Measured,
    effects: tuple[Effect, ...],
    index: int,
    others: tuple[Alternative, ...],
) -> Alternatives:
    """An effect and its alternatives, each judged together with the remaining effects as they were fitted with it."""
    sets = [_without_noise(effects), *([effect for effect, _ in other.together] for other in others)]
    errors = (overall_error(simulation.with_effects(*one), measured) for one in sets)
    alike = (effects[index], *(other.effect for other in others))
    return Alternatives(alike, tuple(errors))


def _others(
    simulation: Simulation, measured: Measured, explanation: Explanation
) -> tuple[tuple[tuple[Effect, ...], float], ...]:
    """Each other set of effects with its error."""
    return tuple(
        (effects, overall_error(simulation.with_effects(*effects), measured)) for effects in explanation.others
    )


def _residual_trace(simulation: Simulation, mended: Simulation, measured: Measured) -> ResidualTrace:
    """One-step residuals of both simulations at all usable rows."""
    rows = measured.windows(1)
    before, after = (residuals(which, measured, rows)[:, 0] for which in (simulation, mended))
    return ResidualTrace(
        time=measured.shown_time[rows],
        names=simulation.state_map.names,
        units=simulation.state_map.units,
        before=before,
        after=after,
        states=measured.observation[rows],
        held_out=measured.held_out[rows],
    )
