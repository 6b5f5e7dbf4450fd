"""Tells effects whose fitted values are neutral within rounding, such as a payload of 1e-18 kg."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torchrl_h2o.effects.effect import Effect
from torchrl_h2o.effects.model.body import Payload
from torchrl_h2o.effects.parameter import Parameter

_ROUNDING = 1e-6  # share of a parameter's typical size; fits stop at moves of about this size
_UNKNOWN_SIZE = 1e-3  # assumed size, in the parameter's unit, if there are no trial values


def is_negligible(effect: Effect, trials: tuple[Mapping[str, float], ...] = ()) -> bool:
    """Whether an effect changes nothing once values within rounding of their neutral values are set to these.

    Args:
        effect: the effect at its fitted values.
        trials: trial values of its parameters, from its catalogue entry, which tell the parameters' typical sizes.

    Examples:
        >>> from torchrl_h2o.effects import Gravity, Payload
        >>> is_negligible(Payload(1e-18, x=0.3)), is_negligible(Payload(1e-3, x=0.3)), is_negligible(Gravity(1.0001))
        (True, False, False)
    """
    rounded = {
        name: parameter.neutral
        for name, parameter in effect.parameters.items()
        if _is_rounding(parameter, [trial[name] for trial in trials if name in trial])
    }
    if isinstance(effect, Payload) and "mass" in rounded:
        return True  # wherever it is
    return effect.is_neutral or (bool(rounded) and effect.with_parameters(rounded).is_neutral)


def _is_rounding(parameter: Parameter, trials: list[float]) -> bool:
    value, neutral = parameter.value, parameter.neutral
    if math.isinf(neutral):  # a limit that is never reached
        return abs(value) * _ROUNDING > max([abs(trial) for trial in trials if math.isfinite(trial)], default=1.0)
    moves = [abs(trial - neutral) for trial in trials]
    size = max(moves, default=0.0) or abs(neutral) or _UNKNOWN_SIZE
    return abs(value - neutral) <= _ROUNDING * size  # False for NaN, the neutral value of a number without one
