"""Units of log columns and their conversion to SI."""

from __future__ import annotations

import math
from types import MappingProxyType

# unit -> (SI unit, factor); names are written without "·", "*" and "^" and with plain digits for superscripts
UNITS = MappingProxyType(
    {
        "1": ("1", 1.0),
        "%": ("1", 0.01),
        "s": ("s", 1.0),
        "ms": ("s", 1e-3),
        "us": ("s", 1e-6),
        "ns": ("s", 1e-9),
        "min": ("s", 60.0),
        "m": ("m", 1.0),
        "cm": ("m", 1e-2),
        "mm": ("m", 1e-3),
        "m/s": ("m/s", 1.0),
        "cm/s": ("m/s", 1e-2),
        "mm/s": ("m/s", 1e-3),
        "km/h": ("m/s", 1 / 3.6),
        "m/s2": ("m/s2", 1.0),
        "mm/s2": ("m/s2", 1e-3),
        "g0": ("m/s2", 9.80665),
        "rad": ("rad", 1.0),
        "mrad": ("rad", 1e-3),
        "deg": ("rad", math.pi / 180),
        "rev": ("rad", 2 * math.pi),
        "rad/s": ("rad/s", 1.0),
        "mrad/s": ("rad/s", 1e-3),
        "deg/s": ("rad/s", math.pi / 180),
        "rev/s": ("rad/s", 2 * math.pi),
        "rpm": ("rad/s", math.pi / 30),
        "rad/s2": ("rad/s2", 1.0),
        "deg/s2": ("rad/s2", math.pi / 180),
        "N": ("N", 1.0),
        "mN": ("N", 1e-3),
        "kN": ("N", 1e3),
        "Nm": ("N·m", 1.0),
        "mNm": ("N·m", 1e-3),
        "Ncm": ("N·m", 1e-2),
        "kg": ("kg", 1.0),
        "g": ("kg", 1e-3),
        "A": ("A", 1.0),
        "mA": ("A", 1e-3),
        "V": ("V", 1.0),
        "mV": ("V", 1e-3),
        "W": ("W", 1.0),
    }
)


def to_si(unit: str) -> tuple[str, float]:
    """Return the SI unit of a unit and the conversion factor.

    Args:
        unit: a name such as ``"deg/s"``, ``"mN·m"`` or ``"m/s²"``.

    Returns:
        The SI unit and the factor: value in SI = factor · value.

    Raises:
        KeyError: for an unknown unit; the message lists the known ones.

    Example:
        >>> from torchrl_h2o.data.readers.units import to_si
        >>> to_si("mN·m")
        ('N·m', 0.001)
    """
    name = str(unit).translate(str.maketrans({"·": "", "*": "", "^": "", " ": "", "²": "2"}))
    name = name.replace("µ", "u").replace("°", "deg")
    if name not in UNITS:
        raise KeyError(f"unknown unit {unit!r}; choose from {', '.join(UNITS)}")
    return UNITS[name]
