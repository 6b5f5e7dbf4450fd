"""Effects whose values are neutral within rounding."""

import math

import pytest

from torchrl_h2o.effects import (
    ActionDelay,
    ActionSaturation,
    BodyCentreOfMass,
    Gravity,
    JointDamping,
    LoadFriction,
    Payload,
    ResidualForce,
    StribeckFriction,
    is_negligible,
)

STICKS = StribeckFriction(1e-12, speed=0.5, share=0.1)


@pytest.mark.parametrize(
    "effect",
    [
        Payload(1e-18, x=0.3),
        Payload(0.0, x=1.0),
        Gravity(1.0 + 1e-9),
        ActionDelay(1e-12),
        ActionSaturation(1e9),
        BodyCentreOfMass(1e-12),
        StribeckFriction(1e-12, speed=0.5, share=1e-12),
        LoadFriction(1e-12, weight=0.3),
    ],
)
def test_a_value_within_rounding_is_no_effect(effect):
    assert is_negligible(effect)


@pytest.mark.parametrize(
    "effect",
    [Payload(1e-4), Gravity(1.001), ActionDelay(1e-5), ActionSaturation(0.9), BodyCentreOfMass(1e-12, z=0.01), STICKS],
)
def test_a_small_value_is_an_effect(effect):
    assert not is_negligible(effect)


def test_trials_tell_how_large_a_parameter_usually_is():
    assert is_negligible(JointDamping(1e-4), ({"damping": 500.0},))
    assert not is_negligible(JointDamping(1e-4), ({"damping": 0.05},))
    assert is_negligible(ActionSaturation(1e4), ({"limit": math.inf}, {"limit": 1e-3}))


def test_numbers_without_a_neutral_value_do_not_count():
    assert not is_negligible(ResidualForce(("torque on elbow: 0.4 · sin(7 q)",)))
    assert is_negligible(ResidualForce(("torque on elbow: 0 · sin(7 q)",)))
