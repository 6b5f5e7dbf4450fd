"""Effects on the model."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.models import CART, FILES, as_bytes, spec
from torchrl_h2o.effects import (
    ActuatorTimeConstant,
    Armature,
    BodyCentreOfMass,
    BodyInertia,
    BodyMass,
    CapsuleLength,
    ContactSoftness,
    EarlierCapsules,
    GeomFriction,
    GeomLength,
    GeomSize,
    Gravity,
    GravityTilt,
    JointDamping,
    JointFrictionLoss,
    JointRange,
    JointRest,
    JointSpring,
    JointStiffness,
    LinkLength,
    LinkTurn,
    Payload,
    RollingResistance,
    ServoStiffness,
    Timestep,
    compile_model,
)

EVERYWHERE = [
    Gravity(),
    GeomFriction(),
    GeomSize(),
    RollingResistance(),
    JointDamping(),
    JointFrictionLoss(),
    Armature(),
    BodyMass(),
    BodyInertia(),
    BodyCentreOfMass(),
    Payload(),
    GravityTilt(),
    JointSpring(),
    ContactSoftness(),
    LinkLength(),
    LinkTurn(),
    CapsuleLength(),
    Timestep(),
]
CHEETAH_ONLY = [EarlierCapsules(), GeomLength(), JointStiffness(), JointRest(), JointRange()]


@given(
    task=st.sampled_from([*FILES, CART]),
    neutral=st.lists(st.sampled_from(EVERYWHERE), max_size=4),
)
def test_neutral_effects_leave_the_model_bit_identical(task, neutral):
    assert as_bytes(compile_model(spec(task), neutral)) == as_bytes(compile_model(spec(task)))


def test_all_neutral_effects_together_leave_halfcheetah_bit_identical():
    model = compile_model(spec("HalfCheetah"), EVERYWHERE + CHEETAH_ONLY)
    assert as_bytes(model) == as_bytes(compile_model(spec("HalfCheetah")))


@pytest.mark.parametrize("task", [*FILES, CART])
def test_body_mass_scales_mass_and_inertia_of_the_named_body_alone(task):
    before = compile_model(spec(task))
    name = before.body(1).name
    after = compile_model(spec(task), [BodyMass(1.5, bodies=name)])
    factors = np.ones(before.nbody)
    factors[1] = 1.5
    np.testing.assert_allclose(after.body_mass, factors * before.body_mass, rtol=1e-12)
    inertia = factors[:, None] * before.body_inertia
    np.testing.assert_allclose(after.body_inertia, inertia, rtol=1e-12)


def test_body_masses_compose_with_a_fixed_total():
    torso_then_foot = [BodyMass(2.0, bodies="torso"), BodyMass(3.0, bodies="bfoot")]
    before = compile_model(spec("HalfCheetah")).body_mass
    after = compile_model(spec("HalfCheetah"), torso_then_foot).body_mass
    factors = np.array([1, 2, 1, 1, 3, 1, 1, 1])
    np.testing.assert_allclose(after, factors * before, rtol=1e-12)


@pytest.mark.parametrize(
    ("effect", "field"),
    [
        (JointDamping(0.25, joints="hinge"), "dof_damping"),
        (JointFrictionLoss(0.25, joints="hinge"), "dof_frictionloss"),
        (Armature(0.25, joints="hinge"), "dof_armature"),
    ],
)
def test_what_is_added_to_a_joint_adds_up_on_that_joint(effect, field):
    model = compile_model(spec(CART), [effect, effect])
    np.testing.assert_array_equal(getattr(model, field), [0.0, 0.5])


def test_more_damping_than_there_is_cannot_be_taken_away():
    less = compile_model(spec("HalfCheetah"), [JointDamping(-2.0, joints="bthigh")])
    assert less.dof_damping[3] == 4.0
    with pytest.raises(ValueError, match=r"joint 'bthigh' has a damping of 6, so 7 cannot be removed"):
        compile_model(spec("HalfCheetah"), [JointDamping(-7.0, joints="bthigh")])


def test_rolling_resistance_slows_a_rolling_wheel_by_its_coefficient():
    wheel = """
    <mujoco><option timestep=".0005" cone="elliptic"/><worldbody>
      <geom name="floor" type="plane" size="5 5 1" friction="1 0 0"/>
      <body pos="0 0 .1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
        <joint type="hinge" axis="0 1 0"/>
        <geom name="wheel" type="sphere" size=".1" mass="1" friction="1 0 .5"/></body>
    </worldbody></mujoco>"""

    def deceleration(coefficient: float) -> float:
        effects = [RollingResistance(coefficient, geoms="wheel")]
        model = compile_model(mujoco.MjSpec.from_string(wheel), effects)
        data = mujoco.MjData(model)
        data.qvel[:] = 1.0, 0.0, 10.0
        mujoco.mj_step(model, data, nstep=400)  # until the contact has settled
        start = data.qvel[0]
        mujoco.mj_step(model, data, nstep=400)
        return (start - data.qvel[0]) / 0.2

    # torque c·m·g against the inertia about the contact point, 7/5·m·r²
    expected = 0.002 * 9.81 / (7 / 5 * 0.1)
    assert deceleration(0.0) == pytest.approx(0.0, abs=0.02 * expected)
    assert deceleration(0.002) == pytest.approx(expected, rel=0.02)


def test_rolling_resistance_adds_to_the_rolling_friction_that_acts_already():
    effects = [RollingResistance(0.01, geoms="rod"), RollingResistance(0.02, geoms="rod")]
    geom = compile_model(spec(CART), effects).geom("rod")
    assert geom.condim[0] == 6
    assert geom.friction[2] == pytest.approx(0.03)


def test_a_pattern_with_a_slash_names_the_body_too():
    model = compile_model(spec("HalfCheetah"), [JointRange(2.0, joints="b*/*foot")])
    unchanged = compile_model(spec("HalfCheetah"))
    np.testing.assert_array_equal(model.joint("bfoot").range, 2 * unchanged.joint("bfoot").range)
    np.testing.assert_array_equal(model.joint("ffoot").range, unchanged.joint("ffoot").range)
    np.testing.assert_array_equal(model.joint("bshin").range, unchanged.joint("bshin").range)


@pytest.mark.parametrize(
    ("effect", "complaint"),
    [
        (GeomSize(2.0, geoms="wing*"), r"no geom named 'wing\*'; it has world/floor, cart/box"),
        (JointDamping(1.0, joints=("hinge", "knee")), "no joint named 'knee'; it has cart/slider"),
        (BodyMass(2.0, bodies="world"), "no body named 'world'; it has world/cart, cart/pole"),
        (JointStiffness(2.0), "no joint of slider, hinge has a stiffness that could be scaled"),
        (JointRange(2.0), "no joint of slider, hinge has a range that could be scaled"),
        (GeomLength(2.0, geoms="box"), "no geom of box is given by its two ends"),
        (CapsuleLength(2.0, geoms="box"), "no geom of box is a capsule or a cylinder"),
        (LinkTurn(0.1, bodies="cart"), "body 'cart' has no hinge to turn about"),
    ],
)
def test_what_the_model_does_not_have_is_named_with_what_it_has(effect, complaint):
    with pytest.raises(ValueError, match=f"cannot be put into model 'cart': .*{complaint}"):
        compile_model(spec(CART), [effect])


ARM = """<mujoco model="arm"><worldbody><body name="upper"><joint name="shoulder" pos="0 0 0.1" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0.1 0 0 {end}" size="0.02"/><site name="camera" pos="0 0 {end}"/>
  <body name="lower" pos="0 0 {lower}" euler="0 30 0"><joint name="elbow" pos="0.3 0 0" axis="0 1 0"/>
    <geom type="capsule" size="0.02 0.1"/></body></body></worldbody></mujoco>"""


def test_the_length_of_a_link_moves_what_it_carries():
    """A link from the shoulder at 0.1 m to the elbow, which the lower body's frame has at (0.3, 0, 0) turned by 30°."""
    elbow = 0.3 * math.sin(math.radians(-30.0))  # z of the elbow from the lower body's origin
    shifted = ARM.format(end=-0.4, lower=-0.5 - elbow)
    longer = ARM.format(end=0.1 - 1.2 * 0.5, lower=0.1 - 1.2 * 0.6 - elbow)
    expected = mujoco.MjModel.from_xml_string(longer)
    expected.body_pos[2, 0] = 0.2 * 0.3 * math.cos(math.radians(30.0))  # the elbow is beside the shoulder's axis, too
    found = compile_model(spec(shifted), [LinkLength(1.2, bodies="upper")])
    for field in ("body_pos", "body_mass", "body_ipos", "body_inertia", "jnt_pos", "geom_size", "site_pos"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), atol=1e-9, err_msg=field)


def test_a_link_turns_about_its_joint_with_what_it_carries():
    """A quarter turn about y: what hung below the shoulder, at 0.1 m, lies beside it; the lower body does not turn."""
    before = compile_model(spec(ARM.format(end=-0.4, lower=-0.5)))
    found = compile_model(spec(ARM.format(end=-0.4, lower=-0.5)), [LinkTurn(-math.pi / 2.0, bodies="upper")])
    np.testing.assert_allclose(found.site_pos[0], [0.5, 0.0, 0.1], atol=1e-9)
    np.testing.assert_allclose(found.geom_pos[0], [0.25, 0.0, 0.1], atol=1e-9)
    elbow = 0.3 * np.array([math.cos(math.radians(30.0)), 0.0, -math.sin(math.radians(30.0))])  # in the lower body
    x, _, z = before.body_pos[2] + elbow - [0.0, 0.0, 0.1]
    np.testing.assert_allclose(found.body_pos[2] + elbow - [0.0, 0.0, 0.1], [-z, 0.0, x], atol=1e-9)
    np.testing.assert_array_equal(found.body_quat[2], before.body_quat[2])
    np.testing.assert_allclose(found.body_mass, before.body_mass)
    cheetah = compile_model(spec("HalfCheetah"), [LinkTurn(0.3, bodies="bshin"), LinkTurn(-0.3, bodies="bshin")])
    np.testing.assert_allclose(cheetah.geom_quat, compile_model(spec("HalfCheetah")).geom_quat, atol=1e-9)


def test_a_capsule_becomes_longer_about_its_centre_and_keeps_its_radius():
    before = compile_model(spec("HalfCheetah"))
    found = compile_model(spec("HalfCheetah"), [CapsuleLength(2.0, geoms=("torso", "bfoot"))])
    for name in ("torso", "bfoot"):  # the first is given by its ends
        np.testing.assert_allclose(found.geom(name).size[:2], before.geom(name).size[:2] * [1.0, 2.0])
        np.testing.assert_allclose(found.geom(name).pos, before.geom(name).pos, atol=1e-9)


def test_capsules_weigh_as_cylinders_that_are_longer_by_a_radius():
    """Also two on one body: the same model with cylinders in their place has the same inertials."""
    leg = """<mujoco><compiler {total}/><worldbody><body name="leg"><joint/><geom type="{kind}" size="0.05 {thigh}"/>
      <geom type="{kind}" size="0.02 {shin}" pos="0.1 0 -0.3" euler="0 40 0"/>
      <geom size="0.1" pos="0 0 0.3"/></body><body name="arm"><joint/><geom size="0.2"/></body></worldbody></mujoco>"""
    for total in ("", 'settotalmass="3"'):
        capsules = leg.format(kind="capsule", thigh=0.2, shin=0.1, total=total)
        cylinders = leg.format(kind="cylinder", thigh=0.225, shin=0.11, total=total)
        found, expected = compile_model(spec(capsules), [EarlierCapsules(1.0)]), compile_model(spec(cylinders))
        for field in ("body_mass", "body_ipos", "body_inertia"):
            same = np.sort(getattr(found, field)), np.sort(getattr(expected, field))  # the axes' order is free
            np.testing.assert_allclose(*same, atol=1e-9, err_msg=field)
    half = compile_model(spec(leg.format(kind="capsule", thigh=0.2, shin=0.1, total="")), [EarlierCapsules(0.5)])
    exact = compile_model(spec(leg.format(kind="capsule", thigh=0.2, shin=0.1, total="")))
    cylinders = compile_model(spec(leg.format(kind="cylinder", thigh=0.225, shin=0.11, total="")))
    np.testing.assert_allclose(half.body_mass, (exact.body_mass + cylinders.body_mass) / 2)
    with pytest.raises(ValueError, match="no body has a capsule"):
        compile_model(spec(leg.format(kind="cylinder", thigh=0.225, shin=0.11, total="")), [EarlierCapsules(1.0)])


def test_an_exact_name_is_no_pattern():
    names = CART.replace('name="slider"', 'name="j[0]"').replace('name="hinge"', 'name="j0"')
    model = compile_model(spec(names), [JointDamping(1.0, joints="j[0]")])
    np.testing.assert_array_equal(model.dof_damping, [1.0, 0.0])
    model = compile_model(spec(names), [JointDamping(1.0, joints="cart/j[0]")])
    np.testing.assert_array_equal(model.dof_damping, [1.0, 0.0])
    model = compile_model(spec(names), [JointDamping(1.0, joints="j[0-9]")])
    np.testing.assert_array_equal(model.dof_damping, [0.0, 1.0])


def test_edits_are_made_in_their_order():
    doubled = compile_model(spec("HalfCheetah"), [BodyMass(2.0), GeomSize(2.0, geoms="bfoot")])
    # BodyMass doubles the total mass, which the compiler distributes over the larger foot
    assert doubled.body_mass.sum() == pytest.approx(28.0)
    model = compile_model(spec(CART), [GeomFriction(0.5), GeomFriction(0.5)])
    np.testing.assert_array_equal(model.geom("rod").friction, [0.25, 0.00125, 0.000025])


SERVO = """<mujoco>
  <worldbody>
    <body><joint name="hip"/><geom size=".1"/><body><joint name="knee"/><geom size=".1"/></body></body>
  </worldbody>
  <actuator>
    <motor joint="hip"/><position joint="hip" kp="30" kv="1"/><position joint="knee" kp="10"/>
  </actuator>
</mujoco>"""


@pytest.mark.parametrize(("actuators", "stiffness"), [(None, (21.0, 7.0)), ((2,), (30.0, 7.0))])
def test_servo_stiffness_scales_servos_and_leaves_motors_and_damping(actuators, stiffness):
    before = compile_model(mujoco.MjSpec.from_string(SERVO))
    after = compile_model(mujoco.MjSpec.from_string(SERVO), [ServoStiffness(0.7, actuators)])
    np.testing.assert_allclose(after.actuator_gainprm[1:, 0], stiffness)
    np.testing.assert_allclose(after.actuator_biasprm[1:, 1], np.negative(stiffness))
    np.testing.assert_array_equal(after.actuator_biasprm[:, 2], before.actuator_biasprm[:, 2])
    np.testing.assert_array_equal(after.actuator_gainprm[0], before.actuator_gainprm[0])


@pytest.mark.parametrize(
    ("actuators", "complaint"), [((0,), "is a position servo"), ((3,), "not all indices of 3 actuators")]
)
def test_servo_stiffness_needs_a_servo(actuators, complaint):
    with pytest.raises(ValueError, match=complaint):
        compile_model(mujoco.MjSpec.from_string(SERVO), [ServoStiffness(0.7, actuators)])


FILTERED = SERVO.replace('kp="30" kv="1"', 'kp="30" timeconst="0.1"')


def test_time_constants_of_filters_are_scaled_and_other_actuators_are_left():
    after = compile_model(mujoco.MjSpec.from_string(FILTERED), [ActuatorTimeConstant(0.2)])
    before = compile_model(mujoco.MjSpec.from_string(FILTERED))
    np.testing.assert_allclose(after.actuator_dynprm[1, 0], 0.02)
    np.testing.assert_array_equal(after.actuator_dynprm[[0, 2]], before.actuator_dynprm[[0, 2]])


@pytest.mark.parametrize(("actuators", "complaint"), [((2,), "has a filter"), ((3,), "not all indices of 3 actuators")])
def test_a_time_constant_needs_a_filter(actuators, complaint):
    with pytest.raises(ValueError, match=complaint):
        compile_model(mujoco.MjSpec.from_string(FILTERED), [ActuatorTimeConstant(0.2, actuators)])


def test_neutral_servo_stiffness_leaves_the_model_bit_identical():
    plain, neutral = (compile_model(mujoco.MjSpec.from_string(SERVO), given) for given in ([], [ServoStiffness()]))
    assert as_bytes(plain) == as_bytes(neutral)
