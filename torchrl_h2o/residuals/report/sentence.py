"""The whole report in one sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchrl_h2o.residuals.report.contents import (
    EXPLAINED_IN_PART,
    NOT_EXPLAINED,
    ErrorSummary,
    FoundEffect,
    HeadlineError,
    ReportContents,
)
from torchrl_h2o.residuals.report.words import change, duration, effect_name, in_readable_unit, number, quantity

NOT_IN_CATALOGUE = "Something is missing that this catalogue does not explain"


def sentence(report: ReportContents) -> str:
    """The whole report in one sentence."""
    if report.conclusion is not None:
        return f"No conclusion: {report.conclusion.rstrip('. ')}."
    error, kind = _error_words(report.error) if report.error else "", report.verdict and report.verdict.kind
    unknown = ""
    if report.verdict is not None and report.verdict.kind in (EXPLAINED_IN_PART, NOT_EXPLAINED):
        unknown = _listed_with(
            "; ", *report.verdict.reasons, report.verdict.where and f"it shows {report.verdict.where}"
        )
    if kind == NOT_EXPLAINED:
        attempt = report.found and f"the best attempt, {_listed(_found_words(report))}, is not recommended"
        return f"{NOT_IN_CATALOGUE}: {_listed_with('; ', unknown, attempt, error)}."
    if report.found:
        rest = unknown and f"something else is missing that this catalogue does not explain: {unknown}"
        return f"Your simulator lacks: {_listed_with('; ', _listed(_found_words(report)), error, rest)}."
    return f"Nothing is missing: {_listed_with('; ', 'the effects tried explain no more than chance', error)}."


def _listed_with(separator: str, *parts: str) -> str:
    return separator.join(part for part in parts if part)


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
    if error.headline is not None:
        return headline_words(error.headline)
    if not (math.isfinite(error.before) and math.isfinite(error.after)):
        return ""
    floor = "" if number(error.floor) == "–" else f", floor {number(error.floor, 2)}"
    if error.after == error.before:
        return f"one-step error {quantity(error.after, error.unit, 2)}{floor}"
    percent = change(error.before, error.after)
    percent = f" ({percent})" if percent else ""
    return f"one-step error {number(error.before, 2)} → {quantity(error.after, error.unit, 2)}{percent}{floor}"


def headline_words(error: HeadlineError) -> str:
    """The error of one quantity some time ahead, in words.

    Examples:
        >>> headline_words(HeadlineError("elbow", "rad", 0.1, before=0.074, after=0.014))
        'elbow 100 ms ahead: 74 → 14 mrad (−81 %)'
    """
    what = f"{error.name} {duration(error.seconds)} ahead"
    unit, (before, after) = in_readable_unit(error.unit, error.before, error.after)
    if error.after == error.before:
        return f"{what}: error {quantity(after, unit, 2)}"
    percent = change(before, after)
    return f"{what}: {number(before, 2)} → {quantity(after, unit, 2)}{percent and f' ({percent})'}"
