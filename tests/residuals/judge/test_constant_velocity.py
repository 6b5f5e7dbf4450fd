"""Effects on single joints that predict their motion no better than the guess that velocities stay as they are."""

from dataclasses import replace

import mujoco

from tests.residuals.pendulum import DOUBLE, double_pendulum, recorded
from torchrl_h2o.effects import Armature, Gravity, JointDamping, JointForce
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.judge.constant_velocity import _quantities_of_joints, no_better_than_constant_velocity

SIMULATION = double_pendulum()
SLOW_ELBOW = (JointDamping(0.3, "shoulder"), JointDamping(1.0, "elbow"))


def against(truth, found, noise=0.0):
    measured = recorded(SIMULATION.with_effects(*truth), 2000, noise=noise)
    return no_better_than_constant_velocity(SIMULATION.with_effects(*found), measured, found)


def test_a_heavy_rotor_of_one_joint_is_named_beside_a_right_effect():
    (reason,) = against(SLOW_ELBOW, (JointDamping(0.3, "shoulder"), Armature(30.0, "elbow")))
    assert reason.startswith("with armature of joints elbow + 30 kg·m², the motion of these joints is predicted hardly")
    assert "elbow 100 ms ahead: " in reason


def test_right_effects_are_not_named():
    assert against(SLOW_ELBOW, SLOW_ELBOW) == ()
    assert against(SLOW_ELBOW, SLOW_ELBOW, noise=0.002) == ()


def test_nothing_is_said_of_motion_that_the_sensors_noise_hides():
    assert against(SLOW_ELBOW, SLOW_ELBOW, noise=2.0) == ()


def test_an_effect_of_both_joints_is_judged_by_both():
    found = (*SLOW_ELBOW, JointForce(1e-6, "*"))
    assert against(SLOW_ELBOW, found) == ()


def test_joints_without_names_and_with_several_coordinates_are_found():
    xml = DOUBLE.replace('name="elbow" ', "").replace('<motor joint="elbow" ctrlrange="-0.3 0.3"/>', "")
    nameless = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(xml))
    assert _quantities_of_joints(nameless, Armature(0.1, "lower/*")) == [1, 3]
    body = '<mujoco><worldbody><body><freejoint name="free"/><geom size="0.1"/></body></worldbody></mujoco>'
    names = tuple(map(str, range(13)))
    every = StateMap.of_coordinates(names, ("1",) * 13, range(13), num_states=13)
    flying = Simulation(lambda: mujoco.MjSpec.from_string(body), 1, every)
    assert _quantities_of_joints(flying, JointForce(0.1, "free")) == list(range(13))
    assert _quantities_of_joints(flying, Gravity(0.5)) == []
