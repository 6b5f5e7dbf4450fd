"""Subtracts negative action noise from the noise of the effects before it.

Negative noise cannot be executed, because no effect can remove the random numbers that another effect has added.
Instead, the standard deviations of the effects before it are reduced.
"""

from collections.abc import Sequence
from math import sqrt
from typing import TypeGuard

from torchrl_h2o.effects.action.signal import ActionNoise
from torchrl_h2o.effects.effect import Effect

# share of the variance by which negative noise may exceed the noise before it. A fitted standard deviation is rarely
# exact, so a slight excess removes all of the noise instead of raising an error.
_EXCESS = 0.01
# share of the variance below which the remaining noise is set to zero
_ROUNDING = 1e-9


def balanced(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Returns the effects with negative noise made neutral and the noise before it reduced by the same variance.

    Only noise on exactly the same actuators is reduced; several such effects are reduced in proportion. Variances are
    compared as if no other effect, such as a gain, stood between the two effects.

    Args:
        effects: all effects of a simulator, in their order.

    Returns:
        The same number of effects in the same order; the same objects if there is no negative noise.

    Raises:
        ValueError: if negative noise exceeds the noise before it by more than 1 % of its variance. A smaller
            excess removes all of the noise.

    Examples:
        >>> from torchrl_h2o.effects import ActionNoise
        >>> balanced([ActionNoise(1.0), ActionNoise(-0.6)])
        (ActionNoise(std=0.8, actuators=None), ActionNoise(std=0.0, actuators=None))
        >>> balanced([ActionNoise(-0.6), ActionNoise(1.0)])
        Traceback (most recent call last):
        ...
        ValueError: noise of standard deviation 0.6 taken off all actuators: the effects before it add only 0 on
        exactly these actuators; put it behind an ActionNoise that is at least as large, with the same actuators
    """
    settled = list(effects)
    for place, effect in enumerate(settled):
        if isinstance(effect, ActionNoise) and effect.std < 0.0:
            settled[:place] = _without(effect, settled[:place])
            settled[place] = effect.with_parameters({"std": 0.0})
    return tuple(settled)


def _without(negative: ActionNoise, before: Sequence[Effect]) -> list[Effect]:
    """Returns the effects before negative noise, reduced by its variance."""
    there = sum(effect.std**2 for effect in before if _same_actuators(effect, negative))
    taken = negative.std**2
    if taken > (1.0 + _EXCESS) * there:
        raise ValueError(
            f"{negative.describe()}: the effects before it add only {sqrt(there):g} on exactly these actuators; "
            "put it behind an ActionNoise that is at least as large, with the same actuators"
        )
    left = 1.0 - taken / there
    factor = sqrt(left) if left > _ROUNDING else 0.0
    return [
        effect.with_parameters({"std": factor * effect.std}) if _same_actuators(effect, negative) else effect
        for effect in before
    ]


def _same_actuators(effect: Effect, noise: ActionNoise) -> TypeGuard[ActionNoise]:
    # None stands for all actuators and compares as the empty set
    return isinstance(effect, ActionNoise) and set(effect.actuators or ()) == set(noise.actuators or ())
