"""Puts into a MuJoCo specification all effects that MJCF can hold, and lists the others with the reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from torchrl_h2o.effects.action.play import ActionBacklash, ActionDeadBand, ActionSaturation
from torchrl_h2o.effects.action.signal import ActionBias, ActionGain
from torchrl_h2o.effects.action.timing import ActionDelay, ActionLag, ActionLead
from torchrl_h2o.effects.effect import ActionEffect, Effect, ForceEffect, ModelEffect, ObservationEffect, VaryingEffect
from torchrl_h2o.effects.force.drag import JointForce, LinearDrag, QuadraticDrag
from torchrl_h2o.effects.force.residual_force import ResidualForce
from torchrl_h2o.effects.mjcf.drive import Drive
from torchrl_h2o.effects.model.compilation import compile_model, edit_spec
from torchrl_h2o.effects.pipeline import Pipeline

_LINEAR_IN_TIME = (ActionDelay, ActionLag, ActionLead)  # linear, so a gain before or after them is the same
_ON_ACTUATORS = (ActionGain, ActionBias, ActionSaturation)
# do not lead from a command within the control range out of it
_WITHIN_RANGE = (ActionBacklash, ActionDeadBand, ActionDelay, ActionLag)


@dataclass(frozen=True)
class NotHeld:
    """An effect that MJCF cannot hold.

    Args:
        effect: the effect.
        reason: the reason, as a clause.
    """

    effect: Effect
    reason: str


def put_into_spec(spec: mujoco.MjSpec, effects: Sequence[Effect]) -> tuple[NotHeld, ...]:
    """Puts effects into a specification: model effects, and action effects where an actuator holds them exactly.

    An actuator holds a gain, an offset or a saturation if its force is a linear function of its control, for commands
    within its control range, and if no other effect comes between them and the actuator. The control range stays as it
    is; where the effects reach beyond it, the actuator's force is limited instead.

    Args:
        spec: the specification, edited in place.
        effects: the effects in their order.

    Returns:
        The effects that are not in the specification, in their order. A simulator of the specification with a
        :class:`~torchrl_h2o.effects.Pipeline` of these has all effects.

    Raises:
        ValueError: if the model has no element that one of the effects could act on.

    Examples:
        >>> from torchrl_h2o.effects import ActionDelay, ActionGain, Gravity
        >>> spec = mujoco.MjSpec.from_string('''<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/></body>
        ...   </worldbody><actuator><motor joint="hinge" gear="3"/></actuator></mujoco>''')
        >>> [left] = put_into_spec(spec, [Gravity(2.0), ActionGain(0.7), ActionDelay(0.01)])
        >>> left.effect, left.reason
        (ActionDelay(delay=0.01, actuators=None), 'MJCF has no delay by a part of a control step')
        >>> float(spec.compile().actuator_gainprm[0, 0])
        0.7
    """
    settled = Pipeline(tuple(effects)).settled
    edit_spec(spec, settled)
    model = compile_model(spec)
    actions = [effect for effect in settled if isinstance(effect, ActionEffect) and not effect.is_neutral]
    held = [] if any(_reads_controls(effect) for effect in settled) else _into_actuators(spec, model, actions)
    return tuple(
        NotHeld(effect, _reason(effect, reads_controls=bool(actions) and any(map(_reads_controls, settled))))
        for effect in settled
        if not isinstance(effect, ModelEffect) and not effect.is_neutral and not any(effect is kept for kept in held)
    )


def _into_actuators(spec: mujoco.MjSpec, model: mujoco.MjModel, actions: Sequence[ActionEffect]) -> list[ActionEffect]:
    """Writes action effects into the actuators, the last one first; returns those that the actuators hold."""
    drives = {i: Drive.of(model, i) for i in range(model.nu)}
    # MuJoCo would clamp these commands before the actuator, the effect clamps after it
    beyond = {
        index
        for effect in actions
        if not isinstance(effect, (*_ON_ACTUATORS, *_WITHIN_RANGE))
        for index in _actuators(effect, model)
        if model.actuator_ctrllimited[index]
    }
    held, between = [], []
    for effect in reversed(actions):
        chosen = _actuators(effect, model)
        drive_of = {i: drive for i in chosen if (drive := drives[i]) is not None}
        after = {i: changed for i, drive in drive_of.items() if (changed := drive.after(effect)) is not None}
        possible = len(after) == len(chosen) and not beyond & set(chosen)
        if possible and not any(_in_the_way(effect, other, model) for other in between):
            drives |= after
            held.append(effect)
        else:
            between.append(effect)
    for index in {i for effect in held for i in _actuators(effect, model)}:
        if (drive := drives[index]) is not None:
            drive.write(spec)
    return held


def _in_the_way(effect: ActionEffect, other: ActionEffect, model: mujoco.MjModel) -> bool:
    """Whether the order of an effect and a later one matters."""
    if not set(_actuators(effect, model)) & set(_actuators(other, model)):
        return False
    return not (isinstance(effect, ActionGain) and isinstance(other, _LINEAR_IN_TIME))


def _actuators(effect: ActionEffect, model: mujoco.MjModel) -> list[int]:
    chosen = getattr(effect, "actuators", None)
    return list(range(model.nu)) if chosen is None else list(chosen)


def _reads_controls(effect: Effect) -> bool:
    """Whether an effect is a force that may depend on the executed controls."""
    if isinstance(effect, ResidualForce):
        return any(factor.coordinate.startswith("a") for term in effect.parsed for factor in term.factors)
    return isinstance(effect, ForceEffect) and not isinstance(effect, JointForce | LinearDrag | QuadraticDrag)


def _reason(effect: Effect, *, reads_controls: bool) -> str:
    if isinstance(effect, ObservationEffect):
        return "MJCF describes the mechanism, not the errors of its sensors"
    if isinstance(effect, JointForce):
        return "MJCF has no constant force on a joint without a further actuator"
    if isinstance(effect, ForceEffect):
        return "MJCF has no such force"
    if isinstance(effect, VaryingEffect):
        return "it changes numbers of the model at every physics step"
    if isinstance(effect, ActionDelay):
        return "MJCF has no delay by a part of a control step"
    if isinstance(effect, ActionLag | ActionLead):
        return "an actuator of MuJoCo filters its control at every physics step, this effect once per control step"
    if effect.random:
        return "MJCF has no random actuation"
    if isinstance(effect, _ON_ACTUATORS):
        if reads_controls:
            return "another effect is a force that depends on the executed control"
        return "its actuator is not linear in its control, or another effect on the action comes between them"
    return "MuJoCo's actuators have no such nonlinearity"
