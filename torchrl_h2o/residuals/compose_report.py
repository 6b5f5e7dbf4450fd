"""Composes the report from an explanation and its judgement: numbers and descriptions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from torchrl_h2o.data.audit import Audit
from torchrl_h2o.effects import Effect
from torchrl_h2o.residuals.evidence import Evidence
from torchrl_h2o.residuals.explanation import Explanation
from torchrl_h2o.residuals.judge.judgement import Judgement
from torchrl_h2o.residuals.measured.outside import DISTURBED
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.contents import (
    DataSummary,
    Fitted,
    FoundEffect,
    IndistinguishableGroup,
    Interval,
    OtherExplanation,
    RejectedEffect,
)
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.words import UNDECLARED, effect_name, effect_units, effect_words
from torchrl_h2o.residuals.search import STOP_TEST
from torchrl_h2o.residuals.simulation.simulation import Simulation


def compose_report(
    evidence: Evidence,
    explanation: Explanation,
    judgement: Judgement,
    *,
    wall_s: float | None = None,
    made_by: Mapping[str, Any] | None = None,
) -> Report:
    """Composes the report.

    Args:
        evidence: the simulator and the data.
        explanation: the effects.
        judgement: held-out errors and tests of these effects.
        wall_s: duration of the whole run, in s.
        made_by: see :func:`~torchrl_h2o.provenance.provenance`.
    """
    simulation, measured = evidence.simulation, judgement.measured
    words, units = partial(effect_words, names=simulation.names), partial(effect_units, names=simulation.names)
    together = _fitted_together(explanation)
    return Report(
        simulator=simulation.name,
        data=_data_summary(measured),
        error=judgement.error,
        found=_found(explanation, judgement.errors_after, simulation),
        rejected=_rejected(explanation, judgement, words, units),
        indistinguishable=tuple(
            IndistinguishableGroup(
                group.effects,
                group.errors,
                tuple(map(words, group.effects)),
                tuple(together.get(effect, ()) for effect in group.effects),
            )
            for group in judgement.alternatives
        ),
        predictions=judgement.predictions,
        unexplained_intervals=_intervals(judgement),
        steps=explanation.steps,
        stop_test=STOP_TEST,
        wall_s=wall_s,
        made_by=made_by or {},
        windows=judgement.windows,
        runs=judgement.runs,
        trace=judgement.trace,
        audit=evidence.audit,
        verdict=judgement.verdict,
        failures=judgement.failures,
        ended_in=explanation.ended_in,
        left_out=judgement.left_out,
        others=tuple(
            OtherExplanation(effects, error, tuple(map(words, effects))) for effects, error in judgement.others
        ),
    )


def inconclusive_report(simulation: Simulation, measured: Measured, reason: str, audit: Audit | None = None) -> Report:
    """The report if the data or the simulator allow no conclusion."""
    return Report(simulator=simulation.name, data=_data_summary(measured), conclusion=reason, audit=audit)


def unfinished_report(evidence: Evidence, explanation: Explanation, stage: str) -> Report:
    """The report of a run that is not finished: the effects so far, without errors.

    Args:
        evidence: the simulator and the data.
        explanation: the effects so far.
        stage: the current stage, in words.
    """
    simulation = evidence.simulation
    return Report(
        simulator=simulation.name,
        data=_data_summary(evidence.measured),
        found=_found(explanation, (math.nan,) * len(explanation.parts), simulation),
        failures=explanation.failures,
        steps=explanation.steps,
        unfinished=stage,
        ended_in=explanation.ended_in,
        audit=evidence.audit,
    )


def _found(explanation: Explanation, errors: Sequence[float], simulation: Simulation) -> tuple[FoundEffect, ...]:
    """The effects found, each with the error with it and those before it."""
    return tuple(
        FoundEffect(
            part.effect,
            part.declared,
            part.ci95,
            error,
            ("" if part.declared else f"{UNDECLARED}: ") + effect_words(part.effect, simulation.names),
            effect_units(part.effect, simulation.names),
            part.in_logs,
        )
        for part, error in zip(explanation.parts, errors, strict=True)
    )


def _fitted_together(explanation: Explanation) -> dict[Effect, Fitted]:
    """Maps each alternative to the explanation refitted with it."""
    return {other.effect: other.together for part in explanation.parts for other in part.alike}


def _data_summary(measured: Measured) -> DataSummary:
    return DataSummary(measured.source, len(measured), int(measured.held_out.sum()), measured.left_out)


def _rejected(explanation: Explanation, judgement: Judgement, words, units) -> tuple[RejectedEffect, ...]:
    """The effects that were tried and not put in, each with the reason."""
    alike = {effect_name(other.effect) for part in explanation.parts for other in part.alike}
    reasons = {
        True: "explains the data as well as an effect that was put in",
        False: "explains less than an effect that was put in, or no more than chance",
    }
    return tuple(
        RejectedEffect(
            tried.effect,
            error,
            tried.p_value,
            reasons[effect_name(tried.effect) in alike],
            words(tried.effect),
            units(tried.effect),
        )
        for tried, error in judgement.rejected
    )


def _intervals(judgement: Judgement) -> tuple[Interval, ...]:
    """The remaining disturbances with their times, in s."""
    time = judgement.measured.shown_time
    return tuple(
        Interval(float(time[found.start]), float(time[found.stop - 1]), found.stop - found.start, found.size, DISTURBED)
        for found in judgement.disturbed
    )
