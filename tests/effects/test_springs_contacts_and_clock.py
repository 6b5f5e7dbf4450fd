"""Effects on springs, contacts, the direction of gravity and the timestep, tested by the resulting motion."""

import mujoco
import numpy as np
import pytest

from tests.effects.models import as_bytes, spec
from torchrl_h2o.effects import (
    ContactSoftness,
    GravityTilt,
    JointRest,
    JointSpring,
    Timestep,
    compile_model,
)

SPRUNG = """
<mujoco model="sprung"><compiler angle="{angle}"/><option gravity="0 0 0" timestep=".001"/><worldbody>
  <body name="arm"><joint name="hinge" axis="0 1 0" stiffness="{stiffness}" damping="{damping}"/>
    <geom type="sphere" size=".01" mass="2" pos="0 0 -.5"/></body>
</worldbody></mujoco>"""
BALL = """
<mujoco><option timestep=".001"/><worldbody>
  <geom name="floor" type="plane" size="1 1 1" solref="{solref}" solimp=".9 .9 .001"/>
  <body name="ball" pos="0 0 .1"><freejoint/>
    <geom name="ball" size=".1" mass="1" solref="{solref}" solimp=".9 .9 .001"/></body>
</worldbody></mujoco>"""


def sprung(*effects, stiffness: float = 0.0, damping: float = 0.0, angle: str = "radian") -> mujoco.MjModel:
    xml = SPRUNG.format(stiffness=stiffness, damping=damping, angle=angle)
    return compile_model(mujoco.MjSpec.from_string(xml), effects)


def test_a_spring_swings_a_mass_with_its_period():
    model = sprung(JointSpring(1.5, joints="hinge"), JointSpring(0.5))
    data = mujoco.MjData(model)
    data.qpos[0] = 0.1
    inertia = 2.0 * 0.5**2 + 2 / 5 * 2.0 * 0.01**2
    period = 2 * np.pi * np.sqrt(inertia / 2.0)
    mujoco.mj_step(model, data, nstep=round(period / 2 / 0.001))
    assert data.qpos[0] == pytest.approx(-0.1, rel=1e-2)


@pytest.mark.parametrize("angle", ["radian", "degree"])
def test_a_damped_spring_settles_at_its_shifted_rest(angle):
    model = sprung(JointRest(0.3), JointRest(-0.1, joints="hinge"), stiffness=5.0, damping=3.0, angle=angle)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=5000)
    assert data.qpos[0] == pytest.approx(0.2, rel=1e-3)


def test_what_has_no_spring_has_no_rest_and_no_stiffness_to_take():
    with pytest.raises(ValueError, match="no joint of hinge has a stiffness"):
        sprung(JointRest(0.1))
    with pytest.raises(ValueError, match="joint 'hinge' has a stiffness of 1, so 2 cannot be removed"):
        sprung(JointSpring(-2.0), stiffness=1.0)


@pytest.mark.parametrize("solref", ["0.02 1", "-3000 -100"])
def test_a_contact_twice_as_slow_gives_way_four_times_as_far(solref):
    def depth(*effects) -> float:
        model = compile_model(mujoco.MjSpec.from_string(BALL.format(solref=solref)), effects)
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=3000)
        return 0.1 - data.qpos[2]

    assert depth(ContactSoftness(2.0)) == pytest.approx(4.0 * depth(), rel=0.02)


def test_a_body_falls_along_tilted_gravity():
    ball = '<mujoco><worldbody><body pos="0 0 5"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'

    def acceleration(*effects) -> np.ndarray:
        model = compile_model(mujoco.MjSpec.from_string(ball), effects)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return data.qacc[:3]

    sin, cos = np.sin(0.2), np.cos(0.2)
    np.testing.assert_allclose(acceleration(GravityTilt(pitch=0.2)), [-9.81 * sin, 0, -9.81 * cos], atol=1e-9)
    np.testing.assert_allclose(acceleration(GravityTilt(roll=0.2)), [0, 9.81 * sin, -9.81 * cos], atol=1e-9)
    both = acceleration(GravityTilt(pitch=0.2, roll=0.2))
    assert np.linalg.norm(both) == pytest.approx(9.81)


def test_tilting_back_restores_gravity():
    model = compile_model(spec("Hopper"), [GravityTilt(pitch=0.3), GravityTilt(pitch=-0.3)])
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81], atol=1e-12)


def test_a_scaled_timestep_is_all_that_changes():
    before, after = compile_model(spec("Hopper")), compile_model(spec("Hopper"), [Timestep(1.5)])
    assert after.opt.timestep == 1.5 * before.opt.timestep
    after.opt.timestep = before.opt.timestep
    assert as_bytes(after) == as_bytes(before)


def test_gravity_that_is_not_tilted_keeps_even_the_signs_of_its_zeros():
    xml = '<mujoco><option gravity="-0.0 -0.0 -9.81"/></mujoco>'
    before, after = (compile_model(mujoco.MjSpec.from_string(xml), tilt) for tilt in ([], [GravityTilt()]))
    assert as_bytes(after) == as_bytes(before)
