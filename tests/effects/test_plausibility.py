"""Which of several effects is the more usual one on a real machine."""

import pytest

from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    ActionLag,
    Armature,
    BodyMass,
    GearPlay,
    JointFrictionLoss,
    LoadFriction,
    ObservationDelay,
    StribeckFriction,
)
from torchrl_h2o.effects.catalogue.plausibility import surprise


@pytest.mark.parametrize(
    ("usual", "unusual"),
    [
        (JointFrictionLoss(0.1), BodyMass(1.2)),
        (LoadFriction(0.1), BodyMass(1.2)),
        (StribeckFriction(0.1), BodyMass(1.2)),
        (GearPlay(0.02), BodyMass(1.2)),
        (JointFrictionLoss(0.1), JointFrictionLoss(-0.1)),
        (ActionGain(0.8), ActionGain(0.3)),
        (Armature(0.01), ActionGain(0.8)),
        (ActionLag(0.05), ActionLag(7.0)),
        (ActionDelay(0.02), ActionDelay(0.5)),
        (ObservationDelay(0.02), ObservationDelay(0.5)),
    ],
)
def test_what_nearly_every_machine_has_is_more_usual(usual, unusual):
    assert surprise(usual) < surprise(unusual)
