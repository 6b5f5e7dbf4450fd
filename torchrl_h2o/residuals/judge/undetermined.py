"""Effects whose value the data leave open: the fit's interval holds everything from no effect to the largest one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchrl_h2o.effects import Parameter
from torchrl_h2o.effects.effect import EntryNames
from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.report.words import effect_words, number, quantity


def undetermined_values(parts: Sequence[Part], names: EntryNames) -> tuple[str, ...]:
    """Reasons against effects whose 95 % interval reaches from their neutral value to the end of what is allowed.

    The loss then hardly depends on the value, as with a drive so slow that it does next to nothing: such an effect
    stands for another cause. Of effects with several values, such as a payload at a place, one may well be open.

    Args:
        parts: the effects with their intervals.
        names: names of entries and actuators.

    Example:
        >>> from torchrl_h2o.effects import ActionLag
        >>> from torchrl_h2o.effects.effect import NO_NAMES
        >>> from torchrl_h2o.residuals.explanation import Part
        >>> from torchrl_h2o.residuals.judge.undetermined import undetermined_values
        >>> undetermined_values([Part(ActionLag(6.9), True, {"time_constant": (0.0, 10.0)})], NO_NAMES)
        ("'all actuators follow with a time constant of 6.9 s' is not determined by the data, which allow 0 to 10 s",)
        >>> undetermined_values([Part(ActionLag(0.1), True, {"time_constant": (0.05, 0.15)})], NO_NAMES)
        ()
    """
    return tuple(
        f"'{effect_words(part.effect, names)}' is not determined by the data, which allow {number(low, 3)} to "
        f"{quantity(high, part.effect.parameters[name].unit)}"
        for part in parts
        for name, (low, high) in part.ci95.items()
        if len(part.ci95) == 1 and _is_open(part.effect.parameters[name], low, high)
    )


def _is_open(parameter: Parameter, low: float, high: float) -> bool:
    neutral = parameter.neutral
    if not (math.isfinite(neutral) and low <= neutral <= high):
        return False
    ends = zip((low, high), parameter.bounds, strict=True)
    return any(math.isfinite(bound) and bound != neutral and end == bound for end, bound in ends)
