"""Delays that are shorter than a control step, which estimated or filtered velocities can cause."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_h2o.effects import ActionDelay, ActionLag, Effect, ObservationDelay
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.report.words import effect_words


def short_delays(effects: Sequence[Effect], measured: Measured, control_step: float) -> tuple[str, ...]:
    """Says of delays shorter than a control step that the velocities may cause them.

    A velocity that was filtered, or estimated from positions, is an average over neighbouring rows. Part of an action's
    effect then shows one row later, as with a delay of a fraction of a row.

    Args:
        effects: the effects found.
        measured: the data.
        control_step: the time between two rows, in s.

    Returns:
        One sentence, or nothing without such a delay or with directly measured velocities.
    """
    estimated = measured.estimated_std is not None and bool(measured.estimated_std.any())
    filtered = any(isinstance(effect, ObservationDelay) and effect.entries is not None for effect in effects)
    short = [effect for effect in effects if 0.0 < _time(effect) < control_step]
    if not short or not (estimated or filtered):
        return ()
    words = " and ".join(map(effect_words, short))
    if estimated:
        return (f"Estimated velocities, too, can look like this: {words}.",)
    return (f"Filtered velocities, too, can look like this: {words}; better have them estimated (derivative_of).",)


def _time(effect: Effect) -> float:
    """Delay or time constant, in s, of the actuators or of all sensors; 0 for other effects."""
    if isinstance(effect, ActionLag):
        return effect.time_constant
    if isinstance(effect, ActionDelay) or (isinstance(effect, ObservationDelay) and effect.entries is None):
        return effect.delay
    return 0.0
