"""Delays of less than a control step beside velocities that were filtered or estimated."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionDelay, ActionLag, Gravity, ObservationDelay
from torchrl_h2o.residuals.judge.caveats import short_delays

STEP = 0.02
FILTERED = ObservationDelay(0.01, (1,))
MEASURED = recorded(pendulum(), 50)
ESTIMATED = replace(MEASURED, estimated_std=np.array([0.0, 0.1]))


@pytest.mark.parametrize("short", [ActionDelay(0.005), ActionLag(0.005), ObservationDelay(0.005)])
def test_filtered_and_estimated_velocities_can_cause_a_short_delay(short):
    (words,) = short_delays((Gravity(1.1), FILTERED, short), MEASURED, STEP)
    assert words.startswith("Filtered velocities, too, can look like this: all")
    assert "0.005 s; better have them estimated" in words
    assert short_delays((short,), ESTIMATED, STEP)[0].startswith("Estimated velocities")


@pytest.mark.parametrize(
    ("effects", "data"),
    [
        ((ActionDelay(0.005),), MEASURED),  # the velocities are measured
        ((FILTERED, ActionDelay(0.05)), MEASURED),  # more than a step
        ((FILTERED, Gravity(1.1)), ESTIMATED),
    ],
)
def test_other_delays_have_no_caveat(effects, data):
    assert short_delays(effects, data, STEP) == ()
