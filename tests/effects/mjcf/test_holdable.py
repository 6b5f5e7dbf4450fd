"""Effects in a specification: what actuators hold exactly, and what is left out."""

import mujoco
import numpy as np
import pytest

from torchrl_h2o.effects import (
    ActionBacklash,
    ActionBias,
    ActionDelay,
    ActionGain,
    ActionLag,
    ActionNoise,
    ActionSaturation,
    JointDamping,
    JointForce,
    LoadFriction,
    ObservationNoise,
    Pipeline,
    ResidualForce,
)
from torchrl_h2o.effects.mjcf import put_into_spec

ARM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hip" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/>
      <body pos="0 0 -.5">
        <joint name="knee" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
LIMITED = '<motor joint="hip" gear="3" ctrlrange="-1 2"/><motor joint="knee" ctrlrange="-1 1" forcerange="-.8 .9"/>'
UNLIMITED = '<motor joint="hip" gear="-3"/><general joint="knee" gainprm="-2" biastype="affine" biasprm="0.3"/>'
SERVOS = '<position joint="hip" kp="5" dampratio="1"/><position joint="knee" kp="5" ctrlrange="-1 1"/>'
STATES = '<motor joint="hip"/><general joint="knee" dyntype="filter" dynprm=".1"/>'


def spec(actuators):
    return mujoco.MjSpec.from_string(ARM.format(actuators=actuators))


def torques(model, controls):
    """Torques of the actuators, (B, nv), in a pose off zero, where servos push."""
    data, found = mujoco.MjData(model), []
    for control in controls:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (0.3, -0.4), (0.5, 0.2), control
        mujoco.mj_forward(model, data)
        found.append(data.qfrc_actuator.copy())
    return np.array(found)


def left_out(actuators, *effects):
    """Puts effects into the arm, checks that its torques are those of the effects, and returns what was left out."""
    edited = spec(actuators)
    left = put_into_spec(edited, effects)
    model, original = edited.compile(), spec(actuators).compile()
    within = np.where(original.actuator_ctrllimited, original.actuator_ctrlrange.T, [[-3.0], [3.0]])
    controls = np.random.default_rng(0).uniform(*within, (400, 2))
    controls[:4] = [(a, b) for a in within[:, 0] for b in within[:, 1]]
    remaining = Pipeline(tuple(one.effect for one in left if not one.effect.random))
    every = Pipeline(tuple(effect for effect in effects if not effect.random))
    executed = [np.array([p.begin(0.01).executed(control) for control in controls]) for p in (every, remaining)]
    if not any(one.effect.random for one in left):
        np.testing.assert_allclose(torques(model, executed[1]), torques(original, executed[0]), atol=1e-12)
    assert (model.actuator_ctrlrange == original.actuator_ctrlrange).all()
    return [type(one.effect) for one in left]


@pytest.mark.parametrize("actuators", [LIMITED, UNLIMITED])
@pytest.mark.parametrize(
    "effects",
    [
        [ActionGain(0.7)],
        [ActionGain(1.8)],
        [ActionGain(-1.8, (0,)), ActionGain(0.5, (1,))],
        [ActionBias(0.4)],
        [ActionSaturation(0.6)],
        [ActionGain(1.5), ActionBias(-0.3), ActionSaturation(0.7), ActionGain(0.9)],
        [ActionSaturation(0.5), ActionGain(3.0, (1,)), ActionBias(0.2)],
        [ActionGain(0.0), ActionBias(0.4, (1,))],
    ],
)
def test_motors_hold_gain_offset_and_saturation_exactly(actuators, effects):
    assert left_out(actuators, *effects) == []


def test_servos_hold_a_gain_that_stays_within_their_range():
    assert left_out(SERVOS, ActionBias(0.1), ActionGain(0.7)) == []
    assert left_out(SERVOS, ActionBias(0.1)) == [ActionBias]
    assert left_out(SERVOS, ActionGain(0.7), ActionBias(0.1)) == [ActionGain, ActionBias]
    assert left_out(SERVOS, ActionGain(1.4, (1,))) == [ActionGain]
    assert left_out(SERVOS, ActionGain(1.4, (0,)), ActionBias(0.2, (0,))) == []


def test_an_actuator_with_a_state_holds_nothing():
    assert left_out(STATES, ActionGain(0.7)) == [ActionGain]
    assert left_out(STATES, ActionGain(0.7, (0,))) == []


def test_a_gain_passes_a_delay_and_a_lag_but_not_backlash():
    assert left_out(LIMITED, ActionGain(0.7), ActionDelay(0.013)) == [ActionDelay]
    assert left_out(LIMITED, ActionGain(0.7), ActionLag(0.013)) == [ActionLag]
    assert left_out(LIMITED, ActionBacklash(0.1), ActionGain(0.7)) == [ActionBacklash]
    assert left_out(LIMITED, ActionGain(0.7), ActionBacklash(0.1)) == [ActionGain, ActionBacklash]
    assert left_out(LIMITED, ActionGain(0.7, (0,)), ActionBacklash(0.1, (1,))) == [ActionBacklash]
    assert left_out(LIMITED, ActionBias(0.2), ActionDelay(0.01)) == [ActionBias, ActionDelay]


def test_noise_that_reaches_beyond_the_range_keeps_the_gain_out():
    assert left_out(LIMITED, ActionNoise(0.1), ActionGain(0.7)) == [ActionNoise, ActionGain]
    assert left_out(UNLIMITED, ActionNoise(0.1), ActionGain(0.7)) == [ActionNoise]


def test_a_force_that_reads_the_controls_keeps_the_gain_out():
    by_control, by_angle = (ResidualForce((f"torque on hip: 0.2 · {of}",)) for of in ("a0", "q"))
    assert left_out(LIMITED, ActionGain(0.7), by_control) == [ActionGain, ResidualForce]
    assert left_out(LIMITED, ActionGain(0.7), by_angle) == [ResidualForce]


def test_every_effect_that_is_left_out_has_a_reason_and_neutral_ones_are_none():
    effects = [JointDamping(0.1), ActionDelay(), JointForce(0.2), ObservationNoise(0.1), ActionNoise(0.2), ActionLag(1)]
    effects += [LoadFriction(0.1), LoadFriction(0.0)]
    left = put_into_spec(spec(LIMITED), effects)
    assert [one.effect for one in left] == [effects[i] for i in (2, 3, 4, 5, 6)]
    assert len({one.reason for one in left}) == 5
    assert left[-1].reason == "it changes numbers of the model at every physics step"
