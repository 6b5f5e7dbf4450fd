"""Numbers with units, changes, intervals and effects as text."""

from __future__ import annotations

import dataclasses
import math

from torchrl_h2o.effects import ActionBias, ActionGain, Effect, Parameter, ResidualForce
from torchrl_h2o.effects.effect import NO_NAMES, EntryNames

UNDECLARED = "outside the catalogue"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """Formats a number with a given number of significant digits.

    Args:
        value: the number; None and numbers that are not finite become a dash.
        digits: number of significant digits.

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
    """Formats a number with its unit; the unit ``"1"`` of pure numbers is omitted.

    Examples:
        >>> quantity(0.031415, "rad/s"), quantity(2.0, "1"), quantity(math.inf, "m")
        ('0.0314 rad/s', '2', '–')
    """
    text = number(value, digits)
    return text if unit in ("", "1") or text == "–" else f"{text} {unit}"


_SMALL = {"rad": "mrad", "m": "mm", "s": "ms"}


def in_readable_unit(unit: str, *values: float) -> tuple[str, tuple[float, ...]]:
    """Converts values that are all below 0.1 to thousandths of their unit, if that unit is usual.

    Examples:
        >>> in_readable_unit("rad", 0.074, 0.014), in_readable_unit("rad", 0.5), in_readable_unit("N", 0.01)
        (('mrad', (74.0, 14.0)), ('rad', (0.5,)), ('N', (0.01,)))
    """
    finite = [abs(value) for value in values if math.isfinite(value)]
    if unit not in _SMALL or not finite or not 0.0 < max(finite) < 0.1:
        return unit, values
    return _SMALL[unit], tuple(1e3 * value for value in values)


def duration(seconds: float) -> str:
    """Formats a time: milliseconds below one second.

    Examples:
        >>> duration(0.1), duration(1.0)
        ('100 ms', '1 s')
    """
    return quantity(1e3 * seconds, "ms") if seconds < 1.0 else quantity(seconds, "s")


def change(before: float, after: float) -> str:
    """Formats the change of an error in per cent; empty if it is not defined.

    Examples:
        >>> change(0.031, 0.004), change(1.0, 1.1), change(1.0, 0.00031), change(0.0, 1.0)
        ('−87 %', '+10 %', '−99.97 %', '')
    """
    if not (math.isfinite(before) and math.isfinite(after) and before > 0.0):
        return ""
    percent = 100.0 * (after - before) / before
    left = 100.0 + percent
    # −99.97 % must not be rounded to −100 %, which would mean no error at all
    decimals = min(4, math.ceil(-math.log10(left))) if 0.0 < left < 1.0 else 0
    return f"{percent:+.{decimals}f} %".replace("-", "−")


def interval(low: float, high: float, unit: str) -> str:
    """Formats an interval with enough digits to tell its ends apart.

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
    """Number of significant digits, at least three, that show an interval's width."""
    width, size = high - low, max(abs(low), abs(high))
    if not (math.isfinite(width) and width > 0.0):
        return 3
    return min(9, max(3, 1 + math.ceil(math.log10(size / width))))


def effect_name(effect: Effect) -> str:
    """Names an effect by its class and the elements it acts on.

    Examples:
        >>> from torchrl_h2o.effects import ActionGain, BodyMass, Gravity
        >>> effect_name(Gravity(2.0)), effect_name(BodyMass(1.2, "torso")), effect_name(ActionGain(2.0, (0, 2)))
        ('Gravity', 'BodyMass[torso]', 'ActionGain[0, 2]')
    """
    chosen = [str(entry) for entry in _selected(effect)]
    return type(effect).__name__ + (f"[{', '.join(chosen)}]" if chosen else "")


def _selected(effect: Effect) -> list[str | int]:
    """Elements that an effect acts on; empty if it acts on all."""
    if isinstance(effect, ResidualForce):  # its terms contain values as well as names
        return list(dict.fromkeys(term.joint for term in effect.parsed))
    fields = [getattr(effect, field.name) for field in dataclasses.fields(effect) if "unit" not in field.metadata]
    entries = [entry for value in fields if value != "*" for entry in (value if isinstance(value, tuple) else (value,))]
    return [entry for entry in entries if isinstance(entry, str | int)]


def effect_words(effect: Effect, names: EntryNames = NO_NAMES) -> str:
    """Describes an effect with values rounded to three digits, or to more if three would give the neutral value.

    Args:
        effect: the effect.
        names: names of entries and actuators, as for :meth:`Effect.describe`.

    Examples:
        >>> from torchrl_h2o.effects import ActionGain, Gravity, ObservationGain
        >>> effect_words(Gravity(0.500123))
        'gravity × 0.5'
        >>> effect_words(Gravity(1.003812))
        'gravity × 1.0038'
        >>> effect_words(ObservationGain(1.04, (0,)), {"entries": ["pitch", "rate"]})
        'entries pitch of the observation × 1.04'
        >>> effect_words(ActionGain(0.11), {"actuator_units": ["A"]})
        'all actuators × 0.11 (for a motor of gain 1, a torque constant of 0.11 N·m/A)'
    """
    rounded = {name: _rounded(parameter) for name, parameter in effect.parameters.items()}
    try:
        shown = effect.with_parameters(rounded)
    except ValueError:  # rounding may exceed a bound with more digits
        shown = effect
    return shown.describe(names) + _torque_constant(shown, names)


def _torque_constant(effect: Effect, names: EntryNames) -> str:
    """What the gain of a current is, if all actions that it acts on are currents; the model's own gain is a factor."""
    if not isinstance(effect, ActionGain):
        return ""
    bias = ActionBias(actuators=effect.actuators).parameters_on(names)["bias"]  # it has the unit of the actions
    if bias.unit != "A":
        return ""
    return f" (for a motor of gain 1, a torque constant of {quantity(effect.scale, 'N·m/A')})"


def effect_units(effect: Effect, names: EntryNames = NO_NAMES) -> dict[str, str]:
    """Returns the unit of each parameter by name; names are those of :func:`effect_words`."""
    return {name: parameter.unit for name, parameter in effect.parameters_on(names).items()}


def _rounded(parameter: Parameter) -> float:
    value, neutral = parameter.value, parameter.neutral
    rounded = float(f"{value:.3g}")
    if rounded != neutral or value == neutral:
        return rounded
    return neutral + float(f"{value - neutral:.2g}")
