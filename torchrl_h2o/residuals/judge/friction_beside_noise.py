"""Dry friction found beside noise of the actions that is as large."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from torchrl_h2o.effects import ActionNoise, Effect
from torchrl_h2o.effects.force.residual_force import degrees_of_freedom
from torchrl_h2o.effects.indices import entry_mask
from torchrl_h2o.residuals.judge.settings import VerdictSettings
from torchrl_h2o.residuals.settings import DEFAULTS
from torchrl_h2o.residuals.simulation.simulation import Simulation


def friction_beside_noise(
    simulation: Simulation,
    mended: Simulation,
    effects: Sequence[Effect],
    rules: VerdictSettings = DEFAULTS.verdict,
) -> tuple[str, ...]:
    """Says of dry friction found beside noise of the actions of its size that its value may be wrong.

    Where measured torques are noisy, the noise moves a light link in the simulator, but not in reality, and more
    friction makes up for it. The 95 % interval does not count this.

    Args:
        simulation: the simulator without the effects.
        mended: the simulator with them.
        effects: the effects found.
        rules: the noise, as a share of the friction, from which it is said.

    Returns:
        One sentence, about all joints with so much noise beside their friction, or nothing.
    """
    found = mended.model.dof_frictionloss - simulation.model.dof_frictionloss
    noise = _noise_of_torques(mended.model, effects)
    doubtful = [
        f"{joint.name}, {found[joint.velocity]:.2g} {'N' if joint.sliding else 'N·m'}"
        for joint in degrees_of_freedom(mended.model)
        if found[joint.velocity] > 0.0 and noise[joint.velocity] > rules.noise_beside_friction * found[joint.velocity]
    ]
    if not doubtful:
        return ()
    return (
        f"The noise of the actions is as large as the dry friction of {' and of '.join(doubtful)}: on a light link, "
        "such friction may be too large by half, which its interval does not count; measure torques with less noise.",
    )


def _noise_of_torques(model: mujoco.MjModel, effects: Sequence[Effect]) -> np.ndarray:
    """Standard deviation of the torque, (nv), that noise of the actions adds at the model's first position."""
    variance, data = np.zeros(model.nv), mujoco.MjData(model)
    for effect in effects:
        if isinstance(effect, ActionNoise) and effect.std > 0.0:
            for actuator in np.flatnonzero(entry_mask(data.ctrl, effect.actuators)):
                pair = []
                for control in (0.0, effect.std):
                    data.ctrl[actuator] = control
                    mujoco.mj_forward(model, data)
                    pair.append(data.qfrc_actuator.copy())
                data.ctrl[actuator] = 0.0
                variance += (pair[1] - pair[0]) ** 2
    return np.sqrt(variance)
