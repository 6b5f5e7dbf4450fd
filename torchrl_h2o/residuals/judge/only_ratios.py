"""Masses and motor gains far from the model's, which the motion shows only in proportion to everything else."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_h2o.effects import ActionGain, BodyMass, Effect
from torchrl_h2o.effects.effect import NO_NAMES, EntryNames
from torchrl_h2o.residuals.judge.settings import VerdictSettings
from torchrl_h2o.residuals.report.words import effect_words, number
from torchrl_h2o.residuals.settings import DEFAULTS


def only_ratios(
    effects: Sequence[Effect], names: EntryNames = NO_NAMES, rules: VerdictSettings = DEFAULTS.verdict
) -> tuple[str, ...]:
    """Says of a mass or a motor gain far from the model's that the same motion has another explanation.

    If all masses, rotors, springs, friction and motor forces of a robot are multiplied by one factor, it moves as
    before. So a pole with a fifth of its mass moves as the same pole on a cart that is five times as heavy, with five
    times the friction and a motor that is five times as strong. A guessed motor constant has this effect.

    Args:
        effects: the effects found.
        names: names of entries and actuators, as for :meth:`Effect.describe`.
        rules: the factor from which a mass or gain is mentioned.

    Returns:
        One sentence on the value that is farthest from the model's, or nothing.
    """
    far = [
        effect
        for effect in effects
        if isinstance(effect, BodyMass | ActionGain) and effect.scale > 0.0 and _times(effect) >= rules.far_from_model
    ]
    if not far:
        return ()
    one = max(far, key=_times)
    others = "the other masses, rotors, springs, friction, the motors' forces"
    weigh = "Weigh the part, if the motors' forces are not measured."
    if isinstance(one, ActionGain):
        others, weigh = "masses, rotors, springs, friction, the other motors' forces", "Measure one of them."
    return (
        f"The motion shows masses and forces only in proportion: {effect_words(one, names)} moves the robot as "
        f"everything else × {number(1.0 / one.scale, 3)} would ({others}). {weigh}",
    )


def _times(effect: BodyMass | ActionGain) -> float:
    """How many times larger or smaller than in the model a value is."""
    return max(effect.scale, 1.0 / effect.scale)
