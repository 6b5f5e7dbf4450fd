"""The whole report in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchrl_h2o.residuals.report.contents import ErrorSummary, FoundEffect, ReportContents
from torchrl_h2o.residuals.report.words import change, effect_name, number, quantity


def sentence(report: ReportContents) -> str:
    """The whole report in one sentence."""
    error = _error_words(report.error) if report.error else ""
    if report.conclusion is not None:
        return f"No conclusion: {report.conclusion.rstrip('. ')}."
    if report.found:
        lacking = "; ".join(part for part in (_listed(_found_words(report)), error) if part)
        return f"Your simulator lacks: {lacking}."
    reason = "the effects tried explain no more than chance"
    return f"Nothing is missing: {'; '.join(part for part in (reason, error) if part)}."


def _found_words(report: ReportContents) -> list[str]:
    """Each effect found, with the alternatives that the data cannot rule out."""
    others = {effect_name(group.effects[0]): group.words[1:] for group in report.indistinguishable}
    return [_one_of(found, others.get(found.name, ())) for found in report.found]


def _one_of(found: FoundEffect, others: Sequence[str]) -> str:
    if not others:
        return found.words
    if len(others) == 1:
        return f"either {found.words} or {others[0]} (these data cannot tell them apart)"
    return f"{found.words} or one of {len(others)} others (these data cannot tell them apart)"


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]


def _error_words(error: ErrorSummary) -> str:
    if not (math.isfinite(error.before) and math.isfinite(error.after)):
        return ""
    floor = "" if number(error.floor) == "–" else f", floor {number(error.floor, 2)}"
    if error.after == error.before:
        return f"one-step error {quantity(error.after, error.unit, 2)}{floor}"
    percent = change(error.before, error.after)
    percent = f" ({percent})" if percent else ""
    return f"one-step error {number(error.before, 2)} → {quantity(error.after, error.unit, 2)}{percent}{floor}"
