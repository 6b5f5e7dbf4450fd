"""Description of the data that tell effects apart, or that no such data exist."""

import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionBias, ActionDelay, ActionGain, JointDamping, JointFrictionLoss, ObservationDelay
from torchrl_h2o.residuals.judge.separation import separated_by

SIMULATION = pendulum()


@pytest.fixture(scope="module")
def measured():
    return recorded(SIMULATION, 1000)


def test_effects_that_differ_at_speed_are_told_apart_there(measured):
    words = separated_by(SIMULATION, measured, (JointDamping(0.05), JointDamping(0.1)), [])
    assert "differ most in elbow_velocity" in words
    assert "where elbow_velocity is large" in words


def test_the_size_of_the_difference_is_given_in_its_unit(measured):
    words = separated_by(SIMULATION, measured, (ActionGain(1.0), ActionGain(1.0), ActionGain(0.5)), [])
    assert "where the action of" in words
    assert " rad/s per step" in words


def test_other_effects_stay_in_beside_each_alternative(measured):
    """A motor without torque has no identifiable gain."""
    alternatives = (ActionGain(1.0), ActionGain(1.1))
    free = separated_by(SIMULATION, measured, alternatives, [])
    dead = separated_by(SIMULATION, measured, alternatives, [ActionGain(0.0)])
    assert "differ" in free
    assert dead.startswith("a direct measurement")


def test_other_effects_keep_their_places(measured):
    """A bias before a motor without torque has no effect; one after it has."""
    alternatives, dead = (ActionBias(0.1), ActionBias(0.2)), [ActionGain(0.0)]
    assert separated_by(SIMULATION, measured, alternatives, after=dead).startswith("a direct measurement")
    assert "differ" in separated_by(SIMULATION, measured, alternatives, before=dead)


def test_effects_that_predict_the_same_are_told_apart_by_nothing_that_is_read(measured):
    alternatives = (ActionDelay(0.02), ObservationDelay(0.02))
    assert separated_by(SIMULATION, measured, alternatives, []).startswith("a direct measurement")
    assert "differ" in separated_by(SIMULATION, measured, (*alternatives, JointFrictionLoss(0.1)), [])
