"""How a report speaks: numbers with units, effects by name and in words, everything in one sentence."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torchrl_h2o.effects import Effect, Parameter, ResidualForce
from torchrl_h2o.effects.effect import NO_NAMES, EntryNames

if TYPE_CHECKING:
    from torchrl_h2o.residuals.report.report import ErrorSummary, FoundEffect, Report

UNDECLARED = "not on any list"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits.

    Args:
        value: the number; what is None or not finite becomes a dash.
        digits: significant digits.

    Examples:
        >>> number(0.031415), number(12345.0), number(-2.5e-7), number(1e6), number(None)
        ('0.0314', '12300', '−2.5 × 10⁻⁷', '10⁶', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if -4 <= int(exponent) < 6:
        decimals = max(0, digits - 1 - int(exponent))
        text = f"{float(f'{mantissa}e{exponent}'):.{decimals}f}"
        text = text.rstrip("0").rstrip(".") if decimals else text
    else:
        mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
        power = f"10{str(int(exponent)).translate(_SUPERSCRIPTS)}"
        text = power if mantissa == "1" else f"{mantissa} × {power}"
    return text.replace("-", "−")


def quantity(value: float | None, unit: str, digits: int = 3) -> str:
    """A number and its unit; ``"1"`` is the unit of pure numbers and not written.

    Examples:
        >>> quantity(0.031415, "rad/s"), quantity(2.0, "1"), quantity(math.inf, "m")
        ('0.0314 rad/s', '2', '–')
    """
    text = number(value, digits)
    return text if unit in ("", "1") or text == "–" else f"{text} {unit}"


def change(before: float, after: float) -> str:
    """What became of an error, in per cent; empty where that says nothing.

    Examples:
        >>> change(0.031, 0.004), change(1.0, 1.1), change(1.0, 0.00031), change(0.0, 1.0)
        ('−87 %', '+10 %', '−99.97 %', '')
    """
    if not (math.isfinite(before) and math.isfinite(after) and before > 0.0):
        return ""
    percent = 100.0 * (after - before) / before
    left = 100.0 + percent
    # −99.97 % must not be rounded to −100 %, which is all of it
    decimals = min(4, math.ceil(-math.log10(left))) if 0.0 < left < 1.0 else 0
    return f"{percent:+.{decimals}f} %".replace("-", "−")


def interval(low: float, high: float, unit: str) -> str:
    """An interval in words, with as many digits as tell its ends apart.

    Examples:
        >>> interval(0.4998, 0.5006, "s")
        'between 0.4998 and 0.5006 s'
        >>> interval(math.nan, 1.0, "s")
        'not known'
    """
    if not (math.isfinite(low) and math.isfinite(high)):
        return "not known"
    digits = interval_digits(low, high)
    return f"between {number(low, digits)} and {quantity(high, unit, digits)}"


def interval_digits(low: float, high: float) -> int:
    """The significant digits, at least three, that show an interval's width."""
    width, size = high - low, max(abs(low), abs(high))
    if not (math.isfinite(width) and width > 0.0):
        return 3
    return min(9, max(3, 1 + math.ceil(math.log10(size / width))))


def effect_name(effect: Effect) -> str:
    """The effect's class and what it acts on.

    Examples:
        >>> from torchrl_h2o.effects import ActionGain, BodyMass, Gravity
        >>> effect_name(Gravity(2.0)), effect_name(BodyMass(1.2, "torso")), effect_name(ActionGain(2.0, (0, 2)))
        ('Gravity', 'BodyMass[torso]', 'ActionGain[0, 2]')
    """
    chosen = [str(entry) for entry in _selected(effect)]
    return type(effect).__name__ + (f"[{', '.join(chosen)}]" if chosen else "")


def _selected(effect: Effect) -> list[str | int]:
    """What an effect acts on, where that is not all that there is."""
    if isinstance(effect, ResidualForce):  # its terms, unlike other selections, hold values
        return list(dict.fromkeys(term.joint for term in effect.parsed))
    fields = [getattr(effect, field.name) for field in dataclasses.fields(effect) if "unit" not in field.metadata]
    entries = [entry for value in fields if value != "*" for entry in (value if isinstance(value, tuple) else (value,))]
    return [entry for entry in entries if isinstance(entry, str | int)]


def effect_words(effect: Effect, names: EntryNames = NO_NAMES) -> str:
    """What the effect does, its values rounded to three digits, or more where those would hide that it does anything.

    Args:
        effect: the effect.
        names: as :meth:`Effect.describe` takes them.

    Examples:
        >>> from torchrl_h2o.effects import Gravity, ObservationGain
        >>> effect_words(Gravity(0.500123))
        'gravity × 0.5'
        >>> effect_words(Gravity(1.003812))
        'gravity × 1.0038'
        >>> effect_words(ObservationGain(1.04, (0,)), {"entries": ["pitch", "rate"]})
        'entries pitch of the observation × 1.04'
    """
    rounded = {name: _rounded(parameter) for name, parameter in effect.parameters.items()}
    try:
        return effect.with_parameters(rounded).describe(names)
    except ValueError:  # a bound may have more digits than three
        return effect.describe(names)


def _rounded(parameter: Parameter) -> float:
    value, neutral = parameter.value, parameter.neutral
    rounded = float(f"{value:.3g}")
    if rounded != neutral or value == neutral:
        return rounded
    return neutral + float(f"{value - neutral:.2g}")


def sentence(report: Report) -> str:
    """The whole report in one sentence."""
    error = _error_words(report.error) if report.error else ""
    if report.conclusion is not None:
        return f"No conclusion: {report.conclusion.rstrip('. ')}."
    if report.found:
        lacking = "; ".join(part for part in (_listed(_found_words(report)), error) if part)
        return f"Your simulator lacks: {lacking}."
    reason = "what was tried explains no more than chance would"
    return f"Nothing is missing: {'; '.join(part for part in (reason, error) if part)}."


def _found_words(report: Report) -> list[str]:
    """Each effect found, with those that it cannot be told apart from."""
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
