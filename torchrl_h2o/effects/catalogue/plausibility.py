"""How plausible a fitted effect is: unusual on a real machine, beyond its size, or neutral within rounding."""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco

from torchrl_h2o.effects.action.signal import ActionBias
from torchrl_h2o.effects.action.timing import ActionDelay, ActionLag
from torchrl_h2o.effects.effect import Effect
from torchrl_h2o.effects.gear.friction import LoadFriction, StribeckFriction
from torchrl_h2o.effects.gear.play import GearPlay
from torchrl_h2o.effects.model.body import BodyCentreOfMass, Payload
from torchrl_h2o.effects.model.geom import RollingResistance
from torchrl_h2o.effects.model.joint import Armature, JointDamping, JointFrictionLoss
from torchrl_h2o.effects.model.world import Gravity, Timestep
from torchrl_h2o.effects.observation.sensor import ObservationBias, ObservationDelay
from torchrl_h2o.effects.parameter import Parameter

#: present on nearly every machine, and rarely in its data sheet or its drawing
USUAL = (
    JointFrictionLoss,
    JointDamping,
    Armature,
    LoadFriction,
    StribeckFriction,
    GearPlay,
    RollingResistance,
    ActionDelay,
    ActionLag,
    ActionBias,
    ObservationDelay,
    ObservationBias,
)
#: lateness of drives and sensors, in s
LATE = (ActionDelay, ActionLag, ObservationDelay)
# factor beyond which a wrong property of the model is surprising
_LARGE_FACTOR = 2.0
# delay or time constant of a drive or a sensor, in s, beyond which it is surprising
_VERY_LATE = 0.3
#: known without a measurement
KNOWN = (Gravity, Timestep)
_ROUNDING = 1e-6  # share of a parameter's typical size; fits stop at moves of about this size
_UNKNOWN_SIZE = 1e-3  # assumed size, in the parameter's unit, if there are no trial values


def surprise(effect: Effect) -> int:
    """Ranks how unusual an effect with its value is: 0 for what nearly every machine has, up to 3.

    Friction, damping, rotor inertia, delays and offsets are usual; a wrong mass, length or motor constant is less so,
    and a different gravity or time step is an error of the model. A property that differs by a large factor, and
    friction, damping or rotor inertia below those of the model, count one more, and so does a drive or a sensor that is
    so late that it does next to nothing.

    Args:
        effect: the effect at its fitted value.

    Examples:
        >>> from torchrl_h2o.effects import ActionGain, Armature, Gravity
        >>> surprise(Armature(0.003)), surprise(ActionGain(0.8)), surprise(ActionGain(0.3)), surprise(Gravity(0.8))
        (0, 1, 2, 2)
    """
    rank = 0 if isinstance(effect, USUAL) else 2 if isinstance(effect, KNOWN) else 1
    for parameter in effect.parameters.values():
        if parameter.neutral == 1.0 and parameter.value > 0.0:
            far = abs(math.log(parameter.value)) > math.log(_LARGE_FACTOR)
        elif isinstance(effect, LATE):
            far = parameter.value > _VERY_LATE
        else:
            far = isinstance(effect, USUAL[:3]) and parameter.value < 0.0
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


def is_negligible(effect: Effect, trials: tuple[Mapping[str, float], ...] = ()) -> bool:
    """Whether an effect changes nothing once values within rounding of their neutral values are set to these.

    Args:
        effect: the effect at its fitted values.
        trials: trial values of its parameters, from its catalogue entry, which tell the parameters' typical sizes.

    Examples:
        >>> from torchrl_h2o.effects import Gravity, Payload
        >>> is_negligible(Payload(1e-18, x=0.3)), is_negligible(Payload(1e-3, x=0.3)), is_negligible(Gravity(1.0001))
        (True, False, False)
    """
    rounded = {
        name: parameter.neutral
        for name, parameter in effect.parameters.items()
        if _is_rounding(parameter, [trial[name] for trial in trials if name in trial])
    }
    return effect.is_neutral or (bool(rounded) and effect.with_parameters(rounded).is_neutral)


def _is_rounding(parameter: Parameter, trials: list[float]) -> bool:
    value, neutral = parameter.value, parameter.neutral
    if math.isinf(neutral):  # a limit that is never reached
        return abs(value) * _ROUNDING > max([abs(trial) for trial in trials if math.isfinite(trial)], default=1.0)
    moves = [abs(trial - neutral) for trial in trials]
    size = max(moves, default=0.0) or abs(neutral) or _UNKNOWN_SIZE
    return abs(value - neutral) <= _ROUNDING * size  # False for NaN, the neutral value of a number without one
