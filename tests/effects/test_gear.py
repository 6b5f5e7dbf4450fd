"""Friction of gears and play: torques at the joints, and the motion against models written out by hand."""

import mujoco
import numpy as np
import pytest

from torchrl_h2o.effects import GearPlay, LoadFriction, Pipeline, StribeckFriction
from torchrl_h2o.effects.gear import loads
from torchrl_h2o.effects.gear.loads import JointActuators, Weight
from torchrl_h2o.effects.states import States
from torchrl_h2o.envs.physics import ALONE, FULL_PHYSICS, roll_out

ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="shoulder" axis="0 1 0" damping="0.01" frictionloss="0.05"/>
  <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".3"/>
  <body pos=".2 0 0"><joint name="elbow" axis="0 1 0" actuatorfrcrange="-1 1"/>
    <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".3"/></body></body></worldbody>
<actuator><position joint="shoulder" kp="3" kv=".1" forcerange="-2 2" ctrlrange="-1 1" timeconst=".02"/>
  <position joint="elbow" kp="5" kv=".1" gear="2" ctrlrange="-1 1"/></actuator></mujoco>
"""
SERVO = """
<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
  <joint name="joint" axis="0 1 0" armature="0.002" frictionloss="0.01" damping="0.005"/>{play}
  <geom type="sphere" size=".02" pos="0 0 -.15" mass=".3" contype="0"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>
"""
MOTOR = '<motor joint="joint"/>'
POSITION = '<position joint="joint" kp="2" kv="0.05"/>'
TARGETS = 0.8 * np.sin(2.0 * np.pi * 0.7 * 0.001 * np.arange(2000)) * np.sign(np.sin(2.0 * np.arange(2000) * 0.001))


def moved(effects, xml: str, targets: np.ndarray, start: float = 0.0) -> np.ndarray:
    """Angles of the first joint after each physics step, under targets of the first actuator."""
    pipeline = Pipeline(effects)
    model = pipeline.compile(mujoco.MjSpec.from_string(xml))
    state = np.zeros((1, mujoco.mj_stateSize(model, FULL_PHYSICS)))
    state[0, 1] = start
    pushes = {"forces": pipeline.batched_forces(model), "variations": pipeline.variations(model)}
    reached = roll_out(ALONE, [model], [mujoco.MjData(model)], state, targets[None, :, None], 1, **pushes)
    return reached[0, :, 1]


def test_torques_of_many_states_are_those_of_mujoco():
    model, rng = mujoco.MjModel.from_xml_string(ARM), np.random.default_rng(0)
    actuators, weight, data = JointActuators.on(model), Weight(model), mujoco.MjData(model)
    for _ in range(20):
        data.qpos, data.qvel, data.ctrl, data.act = (rng.normal(size=n) for n in (2, 2, 2, 1))
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(actuators.torques(States.of(data))[0], data.qfrc_actuator, atol=1e-12)
        data.qvel = 0.0
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(weight.torques(States.of(data))[0], -data.qfrc_bias, atol=1e-12)


def test_only_actuators_on_the_joints_count():
    model = mujoco.MjModel.from_xml_string(ARM)
    assert JointActuators.on(model, "elbow").indices.tolist() == [1]


def test_an_actuator_without_a_linear_torque_is_named():
    muscle = '<muscle name="biceps" joint="elbow" lengthrange="0 1"/>'
    model = mujoco.MjModel.from_xml_string(
        ARM.replace('<position joint="elbow" kp="5" kv=".1" gear="2" ctrlrange="-1 1"/>', muscle)
    )
    with pytest.raises(ValueError, match="the torque of actuator 'biceps' is no linear function"):
        Pipeline([LoadFriction(0.1)]).variations(model)


def test_friction_of_the_load_is_that_of_a_model_whose_friction_is_written_at_each_step():
    xml, effect = SERVO.format(play="", actuator=POSITION), LoadFriction(0.15, weight=0.5)
    model = mujoco.MjModel.from_xml_string(xml)
    data, by_hand = mujoco.MjData(model), []
    for target in TARGETS:
        motor = 2.0 * (target - data.qpos[0]) - 0.05 * data.qvel[0]
        weight = -0.3 * 9.81 * 0.15 * np.sin(data.qpos[0])
        model.dof_frictionloss[0] = 0.01 + 0.15 * abs(motor - 0.5 * weight)
        data.ctrl[0] = target
        mujoco.mj_step(model, data)
        by_hand.append(data.qpos[0])
    along = moved([effect], xml, TARGETS)
    np.testing.assert_allclose(along, by_hand, atol=1e-9)
    assert np.abs(along - moved([], xml, TARGETS)).max() > 0.05


def test_the_weight_is_computed_once_for_all_gears_in_a_step(monkeypatch):
    calls, jacobians = [], loads.com_jacobians

    def counted(*args):
        at = jacobians(*args)
        return lambda qpos: calls.append(len(qpos)) or at(qpos)

    monkeypatch.setattr(loads, "com_jacobians", counted)
    model = mujoco.MjModel.from_xml_string(ARM)
    state = np.zeros((1, mujoco.mj_stateSize(model, FULL_PHYSICS)))
    variations = Pipeline([LoadFriction(0.1, joints=joint) for joint in ("shoulder", "elbow")]).variations(model)
    roll_out(ALONE, [model], [mujoco.MjData(model)], state, np.zeros((1, 3, 2)), 1, variations=variations)
    assert calls == [1, 1, 1]


def test_the_model_has_its_own_friction_again_after_a_rollout():
    model = mujoco.MjModel.from_xml_string(SERVO.format(play="", actuator=POSITION))
    variations = Pipeline([LoadFriction(0.5), GearPlay(0.1)]).variations(model)
    before = {field: getattr(model, field).copy() for one in variations for field in one.fields}
    state = np.zeros((1, mujoco.mj_stateSize(model, FULL_PHYSICS)))
    actions = np.full((1, 50, 1), 0.5)
    roll_out(ALONE, [model], [mujoco.MjData(model)], state, actions, 1, variations=variations)
    for field, value in before.items():
        np.testing.assert_array_equal(getattr(model, field), value)


@pytest.mark.parametrize(("push", "slips"), [(0.2, False), (0.4, True)])
def test_friction_at_rest_holds_a_joint_that_slides_once_it_has_moved(push, slips):
    motor = SERVO.format(play="", actuator=MOTOR).replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>')
    effect = StribeckFriction(0.29, speed=0.1)  # beside 0.01 of the model
    torques = np.where(np.arange(600) < 300, push, 0.15)
    along = moved([effect], motor, torques)
    assert (abs(along[299]) > 0.01) == slips
    assert (along[-1] - along[-100] > 0.1) == slips  # 0.15 N·m is less than the friction at rest, more than in motion


def with_play(targets: np.ndarray, play: float) -> np.ndarray:
    """Angles of the link, by a model with a second hinge whose range is the play; the servo measures the link."""
    hinge = f'<joint name="play" axis="0 1 0" limited="true" range="{-play / 2} {play / 2}" solreflimit="0.002 1"/>'
    xml = SERVO.format(play=hinge, actuator=MOTOR).replace("<mujoco>", '<mujoco><compiler angle="radian"/>')
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep, data, angles = 1e-4, mujoco.MjData(model), []
    for target in targets:
        for _ in range(10):
            data.ctrl[0] = 2.0 * (target - data.qpos.sum()) - 0.05 * data.qvel.sum()
            mujoco.mj_step(model, data)
        angles.append(data.qpos.sum())
    return np.array(angles)


def test_play_moves_the_link_as_a_second_hinge_does():
    play, xml = 0.03, SERVO.format(play="", actuator=POSITION)
    targets = 0.6 * np.sin(1.3 * 2.0 * np.pi * 0.001 * np.arange(2000))
    true = with_play(targets, play)
    along = {width: moved([GearPlay(width)], xml, targets) for width in (0.0, 0.01, play)}
    errors = {width: np.sqrt(np.mean((angles - true) ** 2)) for width, angles in along.items()}
    assert errors[play] < 0.8 * errors[0.01] < 0.8 * errors[0.0]


def test_play_begins_anew_where_time_does_not_go_on():
    model = mujoco.MjModel.from_xml_string(SERVO.format(play="", actuator=POSITION))
    (used,), (new,) = (Pipeline([GearPlay(0.05)]).variations(model) for _ in range(2))

    def after(variation, qvel, ctrl, time):
        states = States(np.zeros((1, 1)), np.array([[qvel]]), np.zeros((1, 0)), np.array([[ctrl]]), np.array([time]))
        values = {field: getattr(model, field)[None].copy() for field in variation.fields}
        variation.apply(states, values)
        return values["dof_armature"][0, 0]

    after(used, 1.0, 1.0, 0.0)
    assert after(used, 1.0, -1.0, 0.001) == 0.0  # the teeth part, and the link moves without rotor
    assert after(used, 0.0, 1.0, 5.0) == after(new, 0.0, 1.0, 5.0) == 0.002


def test_a_link_that_falls_on_a_motor_at_rest_keeps_the_teeth_in_contact():
    model = mujoco.MjModel.from_xml_string(SERVO.format(play="", actuator=MOTOR))
    (variation,) = Pipeline([GearPlay(0.05)]).variations(model)
    raised = States(np.array([[1.0]]), np.array([[0.5]]), np.zeros((1, 0)), np.zeros((1, 1)), np.zeros(1))
    values = {field: getattr(model, field)[None].copy() for field in variation.fields}
    variation.apply(raised, values)
    assert values["dof_armature"][0, 0] == 0.002  # friction brakes the rotor less than the weight brakes the link


def test_a_motor_that_pushes_less_than_before_keeps_the_teeth_in_contact():
    """The link then accelerates less, at once."""
    model = mujoco.MjModel.from_xml_string(SERVO.format(play="", actuator=MOTOR))
    (variation,) = Pipeline([GearPlay(0.05)]).variations(model)

    def parts(velocity: float, torque: float, time: float) -> bool:
        """Whether the teeth part, or have parted and meet again with an impact."""
        states = np.zeros((1, 1)), np.array([[velocity]]), np.zeros((1, 0)), np.array([[torque]]), np.array([time])
        values = {field: getattr(model, field)[None].copy() for field in variation.fields}
        impact = variation.apply(States(*states), values)
        return bool(values["dof_armature"][0, 0] == 0.0 or np.any(impact))

    assert not parts(1.0, 0.5, 0.0)
    assert not parts(1.0 + 0.48 * 0.001 / model.dof_M0[0], 0.05, 0.001)
    assert parts(1.0 + 0.51 * 0.001 / model.dof_M0[0], -0.5, 0.002)


def test_a_simulation_that_knows_where_the_teeth_are_goes_on_as_if_it_had_never_stopped():
    xml = SERVO.format(play="", actuator=POSITION)
    model = mujoco.MjModel.from_xml_string(xml)
    states = np.zeros((1, mujoco.mj_stateSize(model, FULL_PHYSICS)))
    targets = 0.6 * np.sin(1.3 * 2.0 * np.pi * 0.001 * np.arange(1200))[None, :, None]

    def after(first: int, last: int, begin: np.ndarray, remembered: np.ndarray | None = None):
        (variation,) = Pipeline([GearPlay(0.05)]).variations(model)
        assert variation.memory is not None
        if remembered is not None:
            variation.memory.write(remembered)
        data = [mujoco.MjData(model)]
        reached = roll_out(ALONE, [model], data, begin, targets[:, first:last], 1, variations=[variation])
        return reached[0], variation.memory.read()

    whole, _ = after(0, 1200, states)
    parted = 0
    for middle in range(100, 1100, 50):
        before, remembered = after(0, middle, states)
        parted += int(remembered[0, 0] == 0.0)
        known, _ = after(middle, 1200, before[-1:], remembered)
        unknown, _ = after(middle, 1200, before[-1:], np.full_like(remembered, np.nan))
        # the first step takes the acceleration from the torques, not from the step before
        np.testing.assert_allclose(known[:100, 1], whole[middle : middle + 100, 1], atol=2e-3)
        if remembered[0, 0] == 0.0:
            assert np.abs(unknown[:100, 1] - whole[middle : middle + 100, 1]).max() > 4e-3
    assert parted >= 3
