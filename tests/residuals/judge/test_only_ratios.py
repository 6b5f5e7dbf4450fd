"""Masses and motor gains that the motion shows only in proportion to everything else."""

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum
from torchrl_h2o.effects import ActionGain, Armature, BodyMass, Gravity, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals.judge.only_ratios import only_ratios


def test_a_light_link_is_like_everything_else_heavier():
    (words,) = only_ratios([BodyMass(0.2, "pole"), JointDamping(4.6, "slider")])
    assert "mass of bodies pole × 0.2 moves the robot as everything else × 5 would" in words
    assert "Weigh the part" in words


def test_a_weak_motor_is_like_everything_else_heavier():
    (words,) = only_ratios([ActionGain(0.25)])
    assert "all actuators × 0.25 moves the robot as everything else × 4 would" in words
    assert "the other motors' forces" in words


def test_of_several_values_the_farthest_is_named():
    (words,) = only_ratios([BodyMass(3.0, "a"), BodyMass(0.1, "b")])
    assert "mass of bodies b × 0.1" in words


@pytest.mark.parametrize("effects", [[], [BodyMass(1.8)], [ActionGain(-1.0)], [ActionGain(0.0)], [Gravity(0.1)]])
def test_other_values_are_not_mentioned(effects):
    assert only_ratios(effects) == ()


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
