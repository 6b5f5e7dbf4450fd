"""Parameters of effects: a value with its unit, its bounds and its neutral value."""

import dataclasses
from dataclasses import dataclass
from typing import Any

#: bounds of a quantity whose size depends on the machine, which may be a watch or a crane, or on the unit of its
#: commands; they only leave out numbers that are too large for MuJoCo (its ``mjMAXVAL`` is 1e10)
ANY_SIZE = (-1e9, 1e9)
#: the same for a quantity that is not negative
ANY_AMOUNT = (0.0, 1e9)


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    Args:
        value: the value, in units of ``unit``.
        unit: the unit, ``"1"`` for a pure number.
        bounds: the smallest and the largest allowed value, both inclusive.
        neutral: the value at which the effect changes nothing.
    """

    value: float
    unit: str
    bounds: tuple[float, float]
    neutral: float

    def __str__(self) -> str:
        return f"{self.value:g}" if self.unit == "1" else f"{self.value:g} {self.unit}"


def parameter(*, unit: str, bounds: tuple[float, float], neutral: float) -> Any:
    """Declares a dataclass field as a parameter of an effect; its default is the neutral value.

    Args:
        unit: the unit, ``"1"`` for a pure number.
        bounds: the smallest and the largest allowed value, both inclusive.
        neutral: the value at which the effect changes nothing.

    Returns:
        The field, for the body of an :class:`Effect` subclass.
    """
    metadata = {"unit": unit, "bounds": bounds, "neutral": neutral}
    return dataclasses.field(default=neutral, metadata=metadata)
