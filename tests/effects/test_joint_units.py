"""Units and words by the type of the joint."""

import dataclasses

import mujoco
import pytest

from tests.effects.models import CART
from torchrl_h2o.effects import (
    Armature,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    JointRest,
    JointSpring,
    joint_names,
    quantity_name,
)

NAMES = joint_names(mujoco.MjModel.from_xml_string(CART))


@pytest.mark.parametrize(
    ("effect", "on_slider", "on_hinge"),
    [
        (JointForce(6.72), "constant force of 6.72 N on joints slider", "constant torque of 6.72 N·m on joints hinge"),
        (JointDamping(0.1), "damping of joints slider + 0.1 N·s/m", "damping of joints hinge + 0.1 N·m·s/rad"),
        (JointFrictionLoss(0.1), "dry friction of joints slider + 0.1 N", "dry friction of joints hinge + 0.1 N·m"),
        (JointSpring(0.1), "stiffness of joints slider + 0.1 N/m", "stiffness of joints hinge + 0.1 N·m/rad"),
        (Armature(0.1), "armature of joints slider + 0.1 kg", "armature of joints hinge + 0.1 kg·m²"),
        (JointRest(0.1), "rest of joints slider + 0.1 m", "rest of joints hinge + 0.1 rad"),
    ],
)
def test_units_and_words_follow_the_type_of_the_joint(effect, on_slider, on_hinge):
    for joint, words in (("slider", on_slider), ("hinge", on_hinge)):
        one = dataclasses.replace(effect, joints=joint)
        assert one.describe(NAMES) == words
        assert str(next(iter(one.parameters_on(NAMES).values()))) in words


def test_joints_of_both_types_have_both_units():
    assert JointForce(2.0).describe(NAMES) == (
        "constant torque (force on sliding joints) of 2 N·m (N on sliding joints) on all joints"
    )


def test_patterns_with_a_body_and_unknown_joints():
    assert JointForce(2.0, "cart/*").describe(NAMES) == "constant force of 2 N on joints cart/*"
    assert JointForce(2.0, "elsewhere").describe(NAMES) == "constant torque of 2 N·m on joints elsewhere"
    assert JointForce(2.0, "slider").describe() == "constant torque of 2 N·m on joints slider"


def test_the_name_of_a_quantity_follows_its_unit():
    assert [quantity_name("torque", unit) for unit in ("N", "N·m")] == ["force", "torque"]
    assert quantity_name("scale", "1") == "scale"
