"""Masses and motor gains far from the model's, which the motion shows only in proportion to everything else."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from torchrl_h2o.effects import ActionGain, BodyMass, Effect, selection
from torchrl_h2o.residuals.report.words import effect_words, number
from torchrl_h2o.residuals.simulation.simulation import Simulation

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
