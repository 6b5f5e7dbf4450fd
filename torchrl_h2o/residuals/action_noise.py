"""Noise of the executed action: found where it makes the next readings likelier, and put into the explanation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from torchrl_h2o.effects import ActionNoise
from torchrl_h2o.likelihood import ENOUGH, Difference
from torchrl_h2o.residuals.explanation import Explanation, Part
from torchrl_h2o.residuals.intervals import CONFIDENCE
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.score import Model
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.start_states import OF_NORMAL, USUAL_FACTORS, Noise, Steps

MIN_CHANGE = 0.1  # smallest reported change, as a share of the variance of the simulator's own action noise
# plausible noise, in root mean squares of the actions: a smaller change is not told from errors of the simulator
LEAST, MOST = 0.05, 2.0
CLEARLY_LESS = 0.25  # share of the simulator's own variance below which any estimate says that it has too much
MOST_LEFT = 1.0 / 3.0  # share of the simulator's error in one step beside which noise of the actions is credible
WITH_ACTION = np.append(USUAL_FACTORS, -2.0)  # logarithms of factors of the noise from which a fit begins
NUDGE = 0.1  # step of the logarithm of the noise for the curvature of the likelihood


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """Estimated noise of the executed action.

    Args:
        std: standard deviation of the executed action about the commanded one, in units of the action, the same for all
            actuators.
        half_width: half-width of its 95 % interval.
        evidence: evidence for it, in nats, in all rows that fits and the selection of effects use: against no noise of
            the actions, and against errors of the actions that last for some rows, as a missing force is.
        confirmed: evidence in the rows for selection alone.
        left: share of the simulator's error in one step that the noise does not stand for.
    """

    std: float
    half_width: float
    evidence: float
    confirmed: float
    left: float


def add_action_noise(simulation: Simulation, measured: Measured, explanation: Explanation) -> Explanation:
    """Adds the action noise that the simulator lacks, or removes the noise that it has in excess.

    Args:
        simulation: the simulator without the effects found.
        measured: the data.
        explanation: effects found so far.

    Returns:
        The explanation with an :class:`~torchrl_h2o.effects.ActionNoise`, whose standard deviation is negative where
        the simulator has too much noise; unchanged if the difference is negligible or not significant.
    """
    if not simulation.model.nu:
        return explanation  # a free motion
    own = [effect for effect in simulation.effects if isinstance(effect, ActionNoise) and effect.actuators is None]
    own_variance = sum(math.copysign(effect.std**2, effect.std) for effect in own)
    noise = estimate_noise(simulation.with_effects(*explanation.effects), measured)
    asked = float(np.sqrt((measured.action**2).mean()))
    is_credible = noise.left < MOST_LEFT and noise.std < MOST * asked
    if not is_credible and noise.std**2 > CLEARLY_LESS * own_variance:
        return explanation  # the data do not tell
    is_found = is_credible and noise.evidence > ENOUGH and noise.confirmed > 0.0
    missing = (noise.std**2 if is_found else 0.0) - own_variance
    if abs(missing) <= max(MIN_CHANGE * own_variance, (LEAST * asked) ** 2):
        return explanation
    std = math.copysign(math.sqrt(abs(missing)), missing)
    half = noise.half_width * noise.std / abs(std) if is_found else 0.0
    part = Part(ActionNoise(std), True, {"std": (std - half, std + half)})
    return explanation.with_parts((*explanation.parts, part))


def estimate_noise(simulation: Simulation, measured: Measured) -> NoiseEstimate:
    """Estimates the noise of the executed action beside that of the sensors and errors of the simulator.

    A Kalman filter predicts the next readings under three hypotheses: noise of the actions, none, and errors of the
    actions that last for some rows, as those of a missing force do. The factors on the noise of the sensors, on the
    simulator's errors and on the noise of the actions are those under which the readings for fits are likeliest. The
    evidence is the difference of the log densities, paired over blocks. MuJoCo clamps controls at the ends of their
    range, and so the noise.

    Args:
        simulation: the simulator with all effects found so far; its own action noise is left out.
        measured: the data.
    """
    model = Model.of(simulation, measured)
    record, parts = model.fit.record, (model.fit.starts, model.selection.starts)
    fit, selection = (Steps.of(record, starts.blocks, starts.about, starts.slope) for starts in parts)
    noisy, silent = (fit.noise(factors) for factors in (fit.fitted_factors(WITH_ACTION), model.fit.starts.factors))
    less, more = (replace(noisy, action=noisy.action * math.exp(step)) for step in (-NUDGE, NUDGE))
    noises = [silent, noisy, less, more]
    densities = [[_density(steps, one) for one in noises] for steps in (fit, selection)]
    without, found, below, above = np.concatenate(densities, axis=1)
    curvature = float((above + below - 2.0 * found).sum()) / NUDGE**2
    scatter = float(np.sqrt((((above - below) / (2.0 * NUDGE)) ** 2).sum()))
    std = noisy.action / OF_NORMAL
    half_width = CONFIDENCE * std * scatter / -curvature if curvature < 0.0 else math.inf
    forces = [steps.with_lasting(noisy.action) for steps in (fit, selection)]
    lasting = forces[0].noise(forces[0].fitted_factors(np.append(model.fit.starts.factors, 0.0)))
    likeliest = np.concatenate([_density(steps, lasting) for steps in forces])
    gains = found - without, found - likeliest
    return NoiseEstimate(
        std,
        half_width,
        evidence=min(Difference(gain).evidence for gain in gains),
        confirmed=min(Difference(gain[len(fit.rows) :]).evidence for gain in gains),
        left=float(np.median(noisy.step / silent.step)),
    )


def _density(steps: Steps, noise: Noise) -> np.ndarray:
    """Log density of the next readings under a noise, in each block, (B)."""
    return steps.filtered([noise])[2][0, :, steps.before :].sum(-1)
