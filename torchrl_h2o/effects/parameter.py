"""What a parameter of an effect is: a value with a unit, bounds and the value that changes nothing."""

import dataclasses
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect, with what a fit or a reader needs to know of it.

    Args:
        value: the value, in ``unit``.
        unit: the unit, ``"1"`` for a pure number.
        bounds: the smallest and the largest legal value, both inclusive.
        neutral: the value at which the effect changes nothing.
    """

    value: float
    unit: str
    bounds: tuple[float, float]
    neutral: float

    def __str__(self) -> str:
        return f"{self.value:g}" if self.unit == "1" else f"{self.value:g} {self.unit}"


def parameter(*, unit: str, bounds: tuple[float, float], neutral: float) -> Any:
    """A dataclass field that is a parameter of an effect; its default is the neutral value.

    Args:
        unit: the unit, ``"1"`` for a pure number.
        bounds: the smallest and the largest legal value, both inclusive.
        neutral: the value at which the effect changes nothing.

    Returns:
        The field, for the body of an :class:`Effect` subclass.
    """
    metadata = {"unit": unit, "bounds": bounds, "neutral": neutral}
    return dataclasses.field(default=neutral, metadata=metadata)
