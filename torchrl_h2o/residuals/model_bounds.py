"""Lowest values of effects that add to a property of joints which must not become negative."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from torchrl_h2o.effects import Armature, Effect, JointDamping, JointFrictionLoss, JointSpring, selection

OWN_VALUES: dict[type[Effect], str] = {
    JointFrictionLoss: "dof_frictionloss",
    JointDamping: "dof_damping",
    Armature: "dof_armature",
    JointSpring: "jnt_stiffness",
}


def lowest_value(effect: Effect, model: mujoco.MjModel, others: Iterable[Effect] = ()) -> float:
    """The lowest value of an effect's parameter at which no joint's property is negative; -inf for other effects.

    Args:
        effect: the effect.
        model: the model without effects.
        others: effects that act beside it; those of the same kind change what may be taken away.

    Examples:
        >>> import mujoco
        >>> from torchrl_h2o.effects import JointDamping
        >>> from torchrl_h2o.residuals.model_bounds import lowest_value
        >>> body = '<body><joint name="hip" damping="0.5"/><geom size="1"/></body>'
        >>> model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
        >>> lowest_value(JointDamping(), model)
        -0.5
    """
    if type(effect) not in OWN_VALUES:
        return -np.inf
    present = _own_values(effect, model)
    for other in others:
        if type(other) is type(effect):
            (added,) = (parameter.value for parameter in other.parameters.values())
            for dof in selection.joint_dofs(model, getattr(other, "joints", "*")):
                if dof in present:
                    present[dof] += added
    return -max(0.0, min(present.values(), default=np.inf))


def _own_values(effect: Effect, model: mujoco.MjModel) -> dict[int, float]:
    """The model's property of each degree of freedom of the effect's joints."""
    field, values = OWN_VALUES[type(effect)], {}
    for dof in selection.joint_dofs(model, getattr(effect, "joints", "*")):
        place = model.dof_jntid[dof] if field.startswith("jnt") else dof
        values[int(dof)] = float(np.ravel(getattr(model, field)[place])[0])
    return values
