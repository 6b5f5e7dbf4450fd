"""The force that a simulator lacks along the measured motion, without and with effects."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import ActionDelay, Armature, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals import Simulation, Split, StateMap
from torchrl_h2o.residuals.measured.missing_force import MissingForces, measured_motion, missing_force, missing_forces

SIMULATION = double_pendulum()
FRICTION = (JointFrictionLoss(0.15, "shoulder"), JointFrictionLoss(0.08, "elbow"))
DAMPING = (JointDamping(0.5),)
MEASURED = recorded(SIMULATION.with_effects(*FRICTION), 3000, noise=0.002)


def forces(truth, found, **options):
    measured = recorded(SIMULATION.with_effects(*truth), 3000, **options)
    return missing_forces(SIMULATION, SIMULATION.with_effects(*found), measured, Split.REPORT)


@pytest.mark.parametrize(
    "truth",
    [FRICTION, *(pytest.param(t, marks=pytest.mark.slow) for t in [DAMPING, (*DAMPING, ActionDelay(0.02))])],
)
def test_right_effects_leave_little_force_missing(truth):
    found = forces(truth, truth, noise=0.002)
    assert found.fall_by(0.2)
    assert not found.rise_by(1.5)
    assert (found.factors < 1.05).all()


def test_a_heavy_rotor_needs_torques_that_no_motor_gave():
    found = forces(FRICTION, (Armature(1.0, "elbow"),), noise=0.002)
    assert found.rise_by(1.5)
    assert int(found.factors.argmax()) == 1
    assert found.factors[0] == pytest.approx(1.0, abs=0.1)


def test_the_right_friction_leaves_nothing_missing_where_torques_jump():
    """MuJoCo's dry friction depends on the torque of each control step, which the mean over a window hides."""
    truth = (JointFrictionLoss(0.15, "elbow"),)
    found = forces(truth, truth, noise=0.001, smooth=0.0)
    assert found.factors[1] < 0.05


def test_the_missing_force_has_the_size_of_the_friction():
    found = forces(FRICTION, ())
    assert found.before == pytest.approx([0.15, 0.08], rel=0.15)
    assert found.after == pytest.approx(found.before)


def test_a_rise_that_others_make_up_for_does_not_count():
    assert MissingForces(np.array([1.0, 1.0]), np.array([2.0, 0.9])).rise_by(1.5)
    assert not MissingForces(np.array([1.0, 1.0]), np.array([2.0, 0.4])).rise_by(1.5)
    assert not MissingForces(np.array([1.0, 1.0]), np.array([1.4, 0.9])).rise_by(1.5)
    assert MissingForces(np.array([1.0, 1.0]), np.array([3.1, 0.1])).rise_by(1.5)


def test_a_small_rise_counts_if_no_force_falls():
    """A right effect lowers one. A force that makes up for noisy torques lowers none."""
    assert MissingForces(np.array([1.0, 1.0]), np.array([1.3, 1.0])).rise_by(1.5)
    assert not MissingForces(np.array([1.0, 1.0]), np.array([1.1, 1.0])).rise_by(1.5)


def test_a_rise_by_the_noise_of_the_sensors_does_not_count():
    heavy = np.array([1.0]), np.array([1.9])
    assert MissingForces(*heavy).rise_by(1.5)
    assert not MissingForces(*heavy, by_noise=np.array([0.9])).rise_by(1.5)


def test_forces_far_below_the_largest_one_do_not_count():
    rounding = MissingForces(np.array([1.0, 1e-9]), np.array([1.0, 1e-6]))
    assert not rounding.rise_by(1.5)
    assert not MissingForces(rounding.after, rounding.before).fall_by(0.5)


def test_there_are_none_without_all_coordinates():
    without_shoulder = StateMap.of_coordinates(("e", "v", "w"), ("rad", "rad/s", "rad/s"), (1, 2, 3), num_states=4)
    blind = replace(SIMULATION, state_map=without_shoulder)
    columns = {name: getattr(MEASURED, name)[:, 1:] for name in ("observation", "following")}
    assert measured_motion(blind, replace(MEASURED, **columns), Split.FIT) is None
    assert missing_forces(SIMULATION, SIMULATION, MEASURED.part(slice(0, 100)), Split.FIT) is None


def test_windows_with_contacts_are_left_out():
    """A foot on the ground: contact forces hang on the acceleration within a step, which the log does not show."""
    ball = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="5 5 1"/>
      <body pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-2 2"/></actuator></mujoco>"""
    names, units = ("x", "z", "vx", "vz"), ("m", "m", "m/s", "m/s")
    state_map = StateMap.of_coordinates(names, units, (0, 1, 2, 3), num_states=4)
    rolling = Simulation(lambda: mujoco.MjSpec.from_string(ball), 1, state_map)
    assert measured_motion(rolling, recorded(rolling, 3000), Split.FIT) is None


def test_the_force_is_unknown_where_a_joint_rests_or_turns_around():
    motion = measured_motion(SIMULATION, MEASURED, Split.FIT)
    assert motion is not None
    one_way = np.abs(np.sign(motion.velocity).sum(1)) == motion.velocity.shape[1]
    known = np.isfinite(missing_force(SIMULATION, motion))
    assert (known <= one_way).all()
    assert 0.3 < known.mean() < one_way.mean() < 1.0
