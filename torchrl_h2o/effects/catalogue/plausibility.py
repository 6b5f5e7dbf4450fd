"""How unusual an effect would be on a real machine: decides between explanations that the data cannot tell apart."""

from __future__ import annotations

import math

import mujoco

from torchrl_h2o.effects.action.signal import ActionBias
from torchrl_h2o.effects.action.timing import ActionDelay, ActionLag
from torchrl_h2o.effects.effect import Effect
from torchrl_h2o.effects.model.body import BodyCentreOfMass, Payload
from torchrl_h2o.effects.model.contact import RollingResistance
from torchrl_h2o.effects.model.gravity import Gravity
from torchrl_h2o.effects.model.joint import Armature, JointDamping, JointFrictionLoss
from torchrl_h2o.effects.model.timestep import Timestep
from torchrl_h2o.effects.observation.sensor import ObservationBias, ObservationDelay
from torchrl_h2o.effects.settings import EFFECT_SETTINGS, EffectSettings

#: present on nearly every machine, and rarely in its data sheet or its drawing
USUAL = (
    JointFrictionLoss,
    JointDamping,
    Armature,
    RollingResistance,
    ActionDelay,
    ActionLag,
    ActionBias,
    ObservationDelay,
    ObservationBias,
)
#: lateness of drives and sensors, in s
LATE = (ActionDelay, ActionLag, ObservationDelay)
#: known without a measurement
KNOWN = (Gravity, Timestep)


def surprise(effect: Effect, settings: EffectSettings = EFFECT_SETTINGS) -> int:
    """Ranks how unusual an effect with its value is: 0 for what nearly every machine has, up to 3.

    Friction, damping, rotor inertia, delays and offsets are usual; a wrong mass, length or motor constant is less so,
    and a different gravity or time step is an error of the model. A property that differs by a large factor, and
    friction, damping or rotor inertia below those of the model, count one more, and so does a drive or a sensor that is
    so late that it does next to nothing.

    Args:
        effect: the effect at its fitted value.
        settings: factor beyond which a property differs by a lot, and lateness that is surprising.

    Examples:
        >>> from torchrl_h2o.effects import ActionGain, Armature, Gravity
        >>> surprise(Armature(0.003)), surprise(ActionGain(0.8)), surprise(ActionGain(0.3)), surprise(Gravity(0.8))
        (0, 1, 2, 2)
    """
    rank = 0 if isinstance(effect, USUAL) else 2 if isinstance(effect, KNOWN) else 1
    for parameter in effect.parameters.values():
        if parameter.neutral == 1.0 and parameter.value > 0.0:
            far = abs(math.log(parameter.value)) > math.log(settings.large_factor)
        elif isinstance(effect, LATE):
            far = parameter.value > settings.late
        else:
            far = isinstance(effect, USUAL[:4]) and parameter.value < 0.0
        rank += far
    return rank


def is_outside(effect: Effect, model: mujoco.MjModel) -> bool:
    """Whether an effect places a mass further away than the model is large, as a fit of an inertia may do.

    Args:
        effect: the effect at its fitted value.
        model: the model, for its size.

    Examples:
        >>> import mujoco
        >>> from torchrl_h2o.effects import Payload
        >>> ball = "<mujoco><worldbody><body><freejoint/><geom size='0.2'/></body></worldbody></mujoco>"
        >>> model = mujoco.MjModel.from_xml_string(ball)
        >>> is_outside(Payload(1.0, z=0.1), model), is_outside(Payload(0.001, z=5.0), model)
        (False, True)
    """
    if not isinstance(effect, BodyCentreOfMass | Payload):
        return False
    return math.hypot(effect.x, effect.y, effect.z) > model.stat.extent
