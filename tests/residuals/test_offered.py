"""Late velocities are read off the data, where the positions show them."""

import numpy as np
import pytest

from tests.data.audit.recorded import arm, changed, recording
from torchrl_h2o.effects import ActionDelay, ActionNoise, ObservationDelay
from torchrl_h2o.residuals.offered import late_velocities, offered_entries
from torchrl_h2o.residuals.record import Record


def filtered(rows: np.ndarray) -> np.ndarray:
    """Velocities through a first-order filter with a time constant of one row."""
    for row in range(1, len(rows)):
        rows[row, 2:] = rows[row - 1, 2:] + 0.63 * (rows[row, 2:] - rows[row - 1, 2:])
    return rows


def test_sensors_are_not_late_in_a_search_because_motors_are():
    effects = [entry.effect for entry in offered_entries(arm())]
    assert not any(isinstance(effect, ObservationDelay) for effect in effects)
    assert any(isinstance(effect, ActionDelay) and effect.actuators is None for effect in effects)


@pytest.mark.parametrize("data", [recording(noise=0.0), recording(noise=0.01), recording(ActionNoise(0.2), noise=0.0)])
def test_velocities_that_are_not_late_stay_readings(data):
    delay, same = late_velocities(arm(), data)
    assert delay is None
    assert same is data


def test_filtered_velocities_are_late_and_say_nothing_new():
    data = changed(recording(noise=0.0), filtered)
    delay, without = late_velocities(arm(), data)
    assert delay.effect.entries == (2, 3)
    low, high = delay.ci95["delay"]
    assert low < delay.effect.delay < high
    assert low < 0.6 * arm().control_step < high
    assert without.estimated_std[:2].max() == 0.0 < without.estimated_std[2:].min()
    assert Record(arm(), without).seen.tolist() == [0, 1]


def test_a_delay_that_the_simulator_has_is_not_found_again():
    data = changed(recording(noise=0.0), filtered)
    delay, _ = late_velocities(arm(), data)
    again, without = late_velocities(arm(delay.effect), data)
    assert again is None
    assert without.estimated_std[2:].min() > 0.0
