"""Masses and motor gains that the motion shows only in proportion to everything else."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import DOUBLE, double_pendulum
from torchrl_h2o.effects import ActionGain, Armature, BodyMass, Gravity, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals.judge.caveats import only_ratios

SIMULATION = double_pendulum()


def said(*effects, simulation=SIMULATION):
    return only_ratios(simulation, effects)


def test_a_light_link_is_like_everything_else_heavier():
    (words,) = said(BodyMass(0.2, "lower"), JointDamping(4.6, "elbow"))
    assert "mass of bodies lower × 0.2 could as well be everything else × 5 (the other masses, rotors" in words
    assert words.endswith("Weigh the part, unless the motors are known well.")


def test_a_light_robot_has_no_other_masses():
    (words,) = said(BodyMass(0.2))
    assert "everything else × 5 (rotors, springs" in words
    assert "Weigh the robot" in words


def test_a_weak_motor_is_like_everything_else_heavier():
    (words,) = said(ActionGain(0.25))
    assert "all actuators × 0.25 could as well be everything else × 4 (masses, rotors" in words


def test_of_several_values_the_farthest_is_named():
    (words,) = said(BodyMass(3.0, "upper"), BodyMass(0.1, "lower"))
    assert "mass of bodies lower × 0.1" in words


@pytest.mark.parametrize("effects", [[], [BodyMass(1.8)], [ActionGain(-1.0)], [ActionGain(0.0)], [Gravity(0.1)]])
def test_other_values_are_not_mentioned(effects):
    assert said(*effects) == ()


def test_the_gain_of_a_servo_scales_no_force():
    servos = DOUBLE.replace("<motor", '<position kp="8"')
    simulation = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(servos))
    assert said(ActionGain(0.25), simulation=simulation) == ()
    assert len(said(BodyMass(0.2, "lower"), simulation=simulation)) == 1


def test_the_same_motion_follows_from_either():
    """A lower link of a fifth, or an upper one, rotors, friction and motors that are five times as large."""
    simulation, rng = double_pendulum(), np.random.default_rng(0)
    action = rng.uniform(-0.05, 0.05, (1, 300, 2))
    damping, friction, rotor = JointDamping(0.02), JointFrictionLoss(0.004), Armature(0.002)
    one = simulation.with_effects(BodyMass(0.2, "lower"), damping, friction, rotor)
    others = (JointDamping(0.1), JointFrictionLoss(0.02), Armature(0.01), BodyMass(5.0, "upper"), ActionGain(5.0))
    other = simulation.with_effects(*others)
    start = np.array([[0.5, -0.3, 0.0, 0.0]])
    moved, like = (
        one.rollout(start, one.executed(action[0])[None]),
        other.rollout(start, other.executed(action[0])[None]),
    )
    assert moved == pytest.approx(like, abs=1e-3)
    assert np.abs(moved - simulation.rollout(start, action)).max() > 0.1
