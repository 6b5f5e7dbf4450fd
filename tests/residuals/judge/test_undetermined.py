"""Effects whose value the data leave open are no explanation."""

import pytest

from torchrl_h2o.effects import ActionLag, Armature, BodyMass, JointFrictionLoss, Payload
from torchrl_h2o.residuals.explanation import Part
from torchrl_h2o.residuals.judge.caveats import undetermined_values


@pytest.mark.parametrize(
    ("effect", "name", "interval", "open_"),
    [
        (ActionLag(6.9), "time_constant", (0.0, 10.0), True),  # of a real pendulum: a drive that does nothing
        (ActionLag(0.04), "time_constant", (0.0, 0.1), False),  # perhaps none, but certainly no large one
        (ActionLag(9.9), "time_constant", (9.0, 10.0), False),  # at the end of what is allowed: another reason says so
        (BodyMass(3.0), "scale", (0.5, 100.0), True),
        (BodyMass(3.0), "scale", (1.3, 4.8), False),
        (JointFrictionLoss(0.1), "torque", (-0.1, 0.3), False),
        (Armature(0.01), "inertia", (0.0, 0.02), False),
        (Payload(0.02, x=0.1), ("mass", "x"), (-10.0, 10.0), False),  # its mass may be known and its place not
    ],
)
def test_an_interval_from_no_effect_to_the_largest_one_is_a_reason_against_it(effect, name, interval, open_):
    reasons = undetermined_values(
        [Part(effect, True, dict.fromkeys([name] if isinstance(name, str) else name, interval))], {}
    )
    assert len(reasons) == open_
    assert all("is not determined by the data" in reason for reason in reasons)
