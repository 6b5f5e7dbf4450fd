"""Terms of a generalised force in text form: ``torque on elbow: 0.41 · sin(7 q)``.

A term is a coefficient times factors from a fixed set. Terms are parsed with patterns; no text is evaluated as code.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchrl_h2o.effects.parameter import ANY_SIZE, Parameter

_TIMES = " · "
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_TERM = re.compile(rf"(torque|force) on (.+): ({_NUMBER})((?: · .+)?)")
_COORDINATE = r"(q|v|t|a\d+)"
_FACTORS = {
    "power": re.compile(rf"{_COORDINATE}(?:\^(\d))?"),
    "size": re.compile(rf"\|{_COORDINATE}\|"),
    "sign": re.compile(rf"sign\({_COORDINATE}\)"),
    "sin": re.compile(rf"sin\(({_NUMBER}) {_COORDINATE}(?: ([+-]) ({_NUMBER}))?\)"),
    "step": re.compile(rf"step\(t - ({_NUMBER})\)"),
}
_RAISED = str.maketrans({"2": "²", "3": "³", "4": "⁴", "5": "⁵", "6": "⁶", "7": "⁷", "8": "⁸", "9": "⁹"})


@dataclass(frozen=True)
class Factor:
    """One factor of a term, a function of one coordinate.

    A coordinate is the position ``q`` or velocity ``v`` of the degree of freedom that the force acts on, an entry of
    the controls such as ``a0``, or the time ``t``, in SI units.

    Args:
        function: ``power``, ``size`` (the absolute value), ``sign``, ``sin`` or ``step``.
        coordinate: ``q``, ``v``, ``a0``, ``a1``, ..., or ``t``.
        exponent: exponent of a power.
        numbers: frequency and phase of a sine; start time of a step.

    Examples:
        >>> str(Factor("sin", "q", numbers=(7.0, 0.5))), str(Factor("power", "v", 3))
        ('sin(7 q + 0.5)', 'v^3')
    """

    function: str
    coordinate: str
    exponent: int = 1
    numbers: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> "Factor":
        """Parses a factor; raises ValueError for a string that is not a factor."""
        for function, pattern in _FACTORS.items():
            if match := pattern.fullmatch(text):
                return cls._read(function, match.groups())
        raise ValueError(
            f"{text!r} is no factor of a force; write it like q, v^3, |v|, sign(v), sin(7 q + 0.5), a0 or step(t - 2)"
        )

    @classmethod
    def _read(cls, function: str, groups: Sequence[str | Any]) -> "Factor":
        if function == "power":
            return cls(function, groups[0], int(groups[1] or 1))
        if function == "sin":
            frequency, coordinate, sign, phase = groups
            return cls(function, coordinate, numbers=(float(frequency), float(f"{sign or '+'}{phase or 0}")))
        if function == "step":
            return cls(function, "t", numbers=(float(groups[0]),))
        return cls(function, groups[0])

    def __str__(self) -> str:
        return self.written(_exact)

    def written(self, number: Callable[[float], str]) -> str:
        """Returns the text of the factor, with its numbers formatted by a function."""
        if self.function == "power":
            return self.coordinate if self.exponent == 1 else f"{self.coordinate}^{self.exponent}"
        if self.function == "size":
            return f"|{self.coordinate}|"
        if self.function == "step":
            return f"step(t - {number(self.numbers[0])})"
        if self.function == "sign":
            return f"sign({self.coordinate})"
        frequency, phase = self.numbers
        shift = "" if number(abs(phase)) == "0" else f" {'+' if phase > 0 else '-'} {number(abs(phase))}"
        return f"sin({number(frequency)} {self.coordinate}{shift})"

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Evaluates the factor at values of its coordinate, of any shape."""
        if self.function == "power":
            return values**self.exponent
        if self.function == "sin":
            return np.sin(self.numbers[0] * values + self.numbers[1])
        if self.function == "step":
            return (values >= self.numbers[0]).astype(float)
        return np.abs(values) if self.function == "size" else np.sign(values)

    def parameters(self, sliding: bool) -> dict[str, Parameter]:
        """Returns the numbers by name, with units. Their neutral value is NaN, because they have none.

        Args:
            sliding: whether the degree of freedom is a translation in m rather than a rotation in rad.
        """
        per = {"q": "rad/m" if sliding else "1", "v": "rad·s/m" if sliding else "s", "t": "rad/s"}
        names = {"sin": ("frequency", "phase"), "step": ("start",)}.get(self.function, ())
        units = {"frequency": per.get(self.coordinate, "1"), "phase": "rad", "start": "s"}
        return {
            name: Parameter(value, units[name], ANY_SIZE, np.nan)
            for name, value in zip(names, self.numbers, strict=True)
        }


@dataclass(frozen=True)
class ForceTerm:
    """A coefficient times factors, as a force on one degree of freedom.

    Args:
        joint: the joint's name; for a free or ball joint with the axis appended, ``root_x`` or ``root_pitch``.
        coefficient: coefficient in SI units.
        factors: factors of the term; none for a constant force.
        sliding: whether the term is a force in N rather than a torque in N·m.

    Examples:
        >>> wind = ForceTerm.parse("force on slider: -0.02 · v^3")
        >>> wind.unit, wind.words()
        ('N·s³/m³', 'force on joint slider: -0.02 N·s³/m³ · v³')
    """

    joint: str
    coefficient: float
    factors: tuple[Factor, ...] = ()
    sliding: bool = False

    @classmethod
    def parse(cls, text: str) -> "ForceTerm":
        """Parses a term; raises ValueError for a string that is not a term."""
        match = _TERM.fullmatch(text)
        if match is None:
            raise ValueError(f"{text!r} is no term of a force; write it like 'torque on elbow: 0.41 · sin(7 q)'")
        kind, joint, coefficient, factors = match.groups()
        read = tuple(Factor.parse(factor) for factor in factors.split(_TIMES)[1:])
        return cls(joint, float(coefficient), read, kind == "force")

    def __str__(self) -> str:
        return _TIMES.join([f"{self.kind} on {self.joint}: {_exact(self.coefficient)}", *map(str, self.factors)])

    @property
    def kind(self) -> str:
        """``force`` or ``torque``."""
        return "force" if self.sliding else "torque"

    @property
    def unit(self) -> str:
        """The unit of the coefficient: the unit of the force divided by the units of the factors."""
        length, time = 0, 0
        for factor in self.factors:
            if factor.function in ("power", "size"):
                length += factor.exponent * (factor.coordinate in "qv")
                time += factor.exponent * ((factor.coordinate == "v") - (factor.coordinate == "t"))
        over = [_power("m" if self.sliding else "rad", length)] if length else []
        over += [_power("s", -time)] if time < 0 else []
        force = ["N" if self.sliding else "N·m"] + ([_power("s", time)] if time > 0 else [])
        below = f"({'·'.join(over)})" if len(over) > 1 else "".join(over)
        return "·".join(force) + (f"/{below}" if below else "")

    def words(self) -> str:
        """Describes the term in words, with units."""
        factors = [re.sub(r"\^(\d)", lambda m: m[1].translate(_RAISED), f.written(_rounded)) for f in self.factors]
        return _TIMES.join([f"{self.kind} on joint {self.joint}: {self.coefficient:.4g} {self.unit}", *factors])

    def parameters(self) -> dict[str, Parameter]:
        """Returns the coefficient and the numbers in the factors, by name."""
        found = {"coefficient": Parameter(self.coefficient, self.unit, ANY_SIZE, 0.0)}
        for factor in self.factors:
            for name, value in factor.parameters(self.sliding).items():
                found[name if name not in found else f"second_{name}"] = value
        return found

    def with_parameters(self, values: dict[str, float]) -> "ForceTerm":
        """Returns the term with other values for some or all of its parameters, by name."""
        given = {name: parameter.value for name, parameter in self.parameters().items()} | values
        numbers = [float(value) for value in given.values()]
        coefficient, rest, factors = numbers[0], numbers[1:], []
        for factor in self.factors:
            factors.append(replace(factor, numbers=tuple(rest[: len(factor.numbers)])))
            rest = rest[len(factor.numbers) :]
        return replace(self, coefficient=coefficient, factors=tuple(factors))

    def shape(self, coordinate: Callable[[str], np.ndarray]) -> np.ndarray | float:
        """Returns the product of the factors.

        Args:
            coordinate: returns the values of a coordinate by its name.
        """
        product = 1.0
        for factor in self.factors:
            product = product * factor(coordinate(factor.coordinate))
        return product


def _power(unit: str, exponent: int) -> str:
    return unit if exponent == 1 else f"{unit}{str(exponent).translate(_RAISED)}"


def _exact(value: float) -> str:
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(float(value))


def _rounded(value: float) -> str:
    return f"{value:.4g}"
