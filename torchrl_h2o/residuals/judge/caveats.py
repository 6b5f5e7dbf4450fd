"""What a reader must know of an explanation's values: friction, masses and gains that may be something else."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from torchrl_h2o.effects import (
    ActionGain,
    ActionNoise,
    BodyMass,
    Effect,
    Parameter,
    selection,
)
from torchrl_h2o.effects.effect import EntryNames
from torchrl_h2o.effects.force.residual_force import degrees_of_freedom
from torchrl_h2o.effects.selection import entry_mask
from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.report.words import effect_words, number, quantity
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
        f"Noise of the actions was found as well, {', '.join(doubtful)}. On a light link, such noise can change the "
        "dry friction that is found, in a simulated leg by a quarter; its interval does not include this error.",
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


# factor on a mass or a motor's gain from which the report says that only ratios show in the motion
FAR_FROM_MODEL = 2.0


def only_ratios(simulation: Simulation, effects: Sequence[Effect]) -> tuple[str, ...]:
    """Says of a mass or a motor gain far from the model's that the same motion has another explanation.

    If all masses and all forces of a robot are multiplied by one factor, it moves as before. So a pole with a fifth of
    its mass moves as the same pole on a cart that is five times as heavy, with five times the friction and a motor that
    is five times as strong. A guessed motor constant has this effect. Gains of servos and of actuators whose force
    depends on the motion are left out: they scale a command and not a force.

    Args:
        simulation: the simulator without the effects.
        effects: the effects found.

    Returns:
        One sentence on the value that is farthest from the model's, or nothing.
    """
    model = simulation.model
    plain = bool((model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE).all())
    kinds = BodyMass | ActionGain if plain else BodyMass
    found = [effect for effect in effects if isinstance(effect, kinds) and effect.scale > 0.0]
    far = [effect for effect in found if _times(effect) >= FAR_FROM_MODEL]
    if not far:
        return ()
    one = max(far, key=_times)
    masses, others, what = "the other masses", "the motors' forces", "the part"
    if isinstance(one, ActionGain):
        masses, others, what = "masses", "all other forces", "a part, or measure a force"
    elif len(selection.body_ids(model, one.bodies)) == model.nbody - 1:
        masses, what = "", "the robot"
    rest = ", ".join(filter(None, (masses, "rotors", "springs", "friction", others)))
    weigh = f"Weigh {what}{'' if isinstance(one, ActionGain) else ', unless the motors are known well'}."
    return (
        "Multiplying all masses and all forces by one factor would not change the motion: "
        f"{effect_words(one, simulation.names)} could as well be everything else × {number(1.0 / one.scale, 3)} "
        f"({rest}). {weigh}",
    )


def _times(effect: BodyMass | ActionGain) -> float:
    """How many times larger or smaller than in the model a value is."""
    return max(effect.scale, 1.0 / effect.scale)


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
        >>> from torchrl_h2o.residuals.judge.caveats import undetermined_values
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
