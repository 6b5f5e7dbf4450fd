"""Units of parameters by the type of the joint: N·m and rad on hinges, N and m on sliding joints.

An effect is plain data without a model, so the joints' types come from the names that :meth:`Effect.describe` takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum

import mujoco

from torchrl_h2o.effects.selection import Names, matching

_ON_SLIDES = {"N·m": "N", "N·m·s/rad": "N·s/m", "N·m/rad": "N/m", "kg·m²": "kg", "rad/s": "m/s", "rad": "m"}
_NAMES_ON_SLIDES = {"torque": "force", "inertia": "mass", "angle": "distance"}
_TYPES = {
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
    mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_FREE: "free",
}


class Motion(Enum):
    """The motion of the joints that an effect acts on; the value is the name of a generalised force on them."""

    ROTATION = "torque"
    TRANSLATION = "force"
    BOTH = "torque (force on sliding joints)"


def joint_names(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Returns the joints of a model for :meth:`Effect.describe`: their names, bodies and types, in the model's order.

    Examples:
        >>> from torchrl_h2o.effects import JointForce
        >>> cart = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint name='rail' type='slide'/><geom size='1'/></body></worldbody></mujoco>"
        ... )
        >>> JointForce(6.7, "rail").describe(), JointForce(6.7, "rail").describe(joint_names(cart))
        ('constant torque of 6.7 N·m on joints rail', 'constant force of 6.7 N on joints rail')
    """
    joints = range(model.njnt)
    return {
        "joints": [model.joint(i).name for i in joints],
        "joint_bodies": [model.body(model.jnt_bodyid[i]).name for i in joints],
        "joint_types": [_TYPES[mujoco.mjtJoint(model.jnt_type[i])] for i in joints],
    }


def motion(patterns: Names | None, names: Mapping[str, Sequence[str]]) -> Motion:
    """Returns the motion of the matching joints; a rotation if the joints or their types are not known.

    Args:
        patterns: name patterns of the joints; None for an effect that does not act on joints.
        names: the model's joints, from :func:`joint_names`.
    """
    types = names.get("joint_types", ())
    if patterns is None or not types:
        return Motion.ROTATION
    try:
        chosen = matching(list(zip(names["joint_bodies"], names["joints"], strict=True)), patterns, "joint")
    except ValueError:  # the effect belongs to another model
        return Motion.ROTATION
    kinds = {types[i] for i in chosen}
    if kinds == {"slide"}:
        return Motion.TRANSLATION
    return Motion.BOTH if kinds & {"slide", "free"} else Motion.ROTATION


def unit_under(motion: Motion, unit: str) -> str:
    """Returns the unit of a parameter on joints with this motion.

    Args:
        motion: the joints' motion.
        unit: the parameter's unit on hinges.

    Examples:
        >>> unit_under(Motion.TRANSLATION, "N·m·s/rad"), unit_under(Motion.TRANSLATION, "1")
        ('N·s/m', '1')
        >>> unit_under(Motion.BOTH, "N·m")
        'N·m (N on sliding joints)'
    """
    sliding = _ON_SLIDES.get(unit)
    if sliding is None or motion is Motion.ROTATION:
        return unit
    return sliding if motion is Motion.TRANSLATION else f"{unit} ({sliding} on sliding joints)"


def quantity_name(name: str, unit: str) -> str:
    """Returns the name of a parameter's quantity: ``"force"`` for a parameter ``torque`` in N.

    Examples:
        >>> quantity_name("torque", "N"), quantity_name("torque", "N·m"), quantity_name("inertia", "kg")
        ('force', 'torque', 'mass')
    """
    return _NAMES_ON_SLIDES.get(name, name) if unit in _ON_SLIDES.values() else name
