"""Settles noise that is taken away against the noise before it.

No process can undo what another one drew; so negative noise is never executed, the noise before it is made smaller.
"""

from collections.abc import Sequence
from math import sqrt

from torchrl_h2o.effects.action.signal import ActionNoise
from torchrl_h2o.effects.effect import Effect
from torchrl_h2o.effects.settings import EFFECT_SETTINGS, EffectSettings


def balanced(effects: Sequence[Effect], settings: EffectSettings = EFFECT_SETTINGS) -> tuple[Effect, ...]:
    """The effects as they are executed: negative noise made neutral, the noise before it smaller by its variance.

    Noise is taken off effects that are on the very same actuators. Several of them shrink in proportion. It is
    measured where it is added: what other effects make of it on its way, such as a gain, does not count.

    Args:
        effects: all effects of a simulator, in their order.
        settings: the tolerance for negative noise that exceeds the noise before it.

    Returns:
        As many effects in the same order, and the very same where there is no negative noise.

    Raises:
        ValueError: if noise is to be taken away where the effects before it do not add as much. Up to 1 % of
            the variance too much is taken for all of it.

    Examples:
        >>> from torchrl_h2o.effects import ActionNoise
        >>> balanced([ActionNoise(1.0), ActionNoise(-0.6)])
        (ActionNoise(std=0.8, actuators=None), ActionNoise(std=0.0, actuators=None))
        >>> balanced([ActionNoise(-0.6), ActionNoise(1.0)])
        Traceback (most recent call last):
        ...
        ValueError: noise of standard deviation 0.6 taken off all actuators: the effects before it add one of 0 on
        exactly these actuators; put it behind an ActionNoise that is at least as large, with the same actuators
    """
    settled = list(effects)
    for place, effect in enumerate(settled):
        if isinstance(effect, ActionNoise) and effect.std < 0.0:
            settled[:place] = _without(effect, settled[:place], settings)
            settled[place] = effect.with_parameters({"std": 0.0})
    return tuple(settled)


def _without(negative: ActionNoise, before: Sequence[Effect], settings: EffectSettings) -> list[Effect]:
    """The effects before negative noise, without the variance that it takes away."""
    there = sum(effect.std**2 for effect in before if _same_actuators(effect, negative))
    taken = negative.std**2
    if taken > (1.0 + settings.noise_excess) * there:
        raise ValueError(
            f"{negative.describe()}: the effects before it add one of {sqrt(there):g} on exactly these actuators; "
            "put it behind an ActionNoise that is at least as large, with the same actuators"
        )
    left = 1.0 - taken / there
    factor = sqrt(left) if left > settings.noise_rounding else 0.0
    return [
        effect.with_parameters({"std": factor * effect.std}) if _same_actuators(effect, negative) else effect
        for effect in before
    ]


def _same_actuators(effect: Effect, noise: ActionNoise) -> bool:
    # None, for all actuators, selects none by index
    return isinstance(effect, ActionNoise) and set(effect.actuators or ()) == set(noise.actuators or ())
