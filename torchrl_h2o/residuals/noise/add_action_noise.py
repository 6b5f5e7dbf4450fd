"""Adds action noise to an explanation if the data scatter more or less than the simulator."""

from __future__ import annotations

import math

from torchrl_h2o.effects import ActionNoise
from torchrl_h2o.residuals.explanation import Explanation, Part
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.noise.estimate import estimate_noise
from torchrl_h2o.residuals.settings import DEFAULTS, LoopSettings
from torchrl_h2o.residuals.simulation.simulation import Simulation

MIN_CHANGE = 0.1  # smallest reported change, as a share of the variance of the simulator's own action noise


def add_action_noise(
    simulation: Simulation,
    measured: Measured,
    explanation: Explanation,
    settings: LoopSettings = DEFAULTS,
) -> Explanation:
    """Adds the action noise that the simulator lacks, or removes the noise that it has in excess.

    Args:
        simulation: the simulator without the effects found.
        measured: the data.
        explanation: effects found so far.
        settings: thresholds and numerics.

    Returns:
        The explanation with an :class:`~torchrl_h2o.effects.ActionNoise`, whose standard deviation is negative where
        the simulator has too much noise; unchanged if the difference is negligible or not significant.
    """
    if not simulation.model.nu:
        return explanation  # a free motion
    own = [effect for effect in simulation.effects if isinstance(effect, ActionNoise) and effect.actuators is None]
    own_variance = sum(math.copysign(effect.std**2, effect.std) for effect in own)
    noise = estimate_noise(simulation.with_effects(*explanation.effects), measured, settings)
    variance = noise.action_std**2 if noise.p_value < settings.level else 0.0
    missing = variance - own_variance
    if abs(missing) <= MIN_CHANGE * own_variance:
        return explanation
    std = math.copysign(math.sqrt(abs(missing)), missing)
    half = noise.half_width if variance else 0.0
    part = Part(ActionNoise(std), True, {"std": (std - half, std + half)})
    return explanation.with_parts((*explanation.parts, part))
