"""Dry friction found beside noise of the actions that is as large."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from torchrl_h2o.effects import ActionNoise, Effect
from torchrl_h2o.effects.force.residual_force import degrees_of_freedom
from torchrl_h2o.effects.selection import entry_mask
from torchrl_h2o.residuals.simulation.simulation import Simulation

# share of a dry friction from which noise of the actions at its joint makes its value doubtful
NOISE_BESIDE_FRICTION = 0.8


def friction_beside_noise(
    simulation: Simulation,
    mended: Simulation,
    effects: Sequence[Effect],
) -> tuple[str, ...]:
    """Says of dry friction found beside noise of the actions of its size that its value may be wrong.

    Where measured torques are noisy, the noise moves a light link in the simulator, but not in reality, and more
    friction makes up for it. The 95 % interval does not count this. Noise of actuators with an activation, such as a
    filter, is left out: it reaches the joint weakened.

    Args:
        simulation: the simulator without the effects.
        mended: the simulator with them.
        effects: the effects found.

    Returns:
        One sentence, about all joints with so much noise beside the friction found there, or nothing.
    """
    found = mended.model.dof_frictionloss - simulation.model.dof_frictionloss
    noise = _noise_of_torques(mended.model, effects)
    doubtful = []
    for joint in degrees_of_freedom(mended.model):
        friction, by_noise = found[joint.velocity], noise[joint.velocity]
        if friction > 0.0 and by_noise > NOISE_BESIDE_FRICTION * friction:
            unit = "N" if joint.sliding else "N·m"
            doubtful.append(f"of {by_noise:.3g} {unit} beside the + {friction:.3g} {unit} of {joint.name}")
    if not doubtful:
        return ()
    return (
        f"Noise of the actions was found as well, {', '.join(doubtful)}. On a light link, such noise can raise the dry "
        "friction that is found, in a simulated leg by half; the interval of the friction does not include this error.",
    )


def _noise_of_torques(model: mujoco.MjModel, effects: Sequence[Effect]) -> np.ndarray:
    """Standard deviation of the torque, (nv), that noise of the actions adds at the model's first position."""
    variance, data = np.zeros(model.nv), mujoco.MjData(model)
    middle = np.where(model.actuator_ctrllimited, model.actuator_ctrlrange.mean(1), 0.0)
    for effect in effects:
        if isinstance(effect, ActionNoise) and effect.std > 0.0:
            for actuator in np.flatnonzero(entry_mask(data.ctrl, effect.actuators)):
                pair = []
                for change in (0.0, effect.std):
                    data.ctrl[:] = middle
                    data.ctrl[actuator] += change
                    mujoco.mj_forward(model, data)
                    pair.append(data.qfrc_actuator.copy())
                variance += (pair[1] - pair[0]) ** 2
    return np.sqrt(variance)
