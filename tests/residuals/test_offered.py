"""The entries that a search tries: late velocities only where the positions show them."""

import numpy as np
import pytest

from tests.data.audit.recorded import arm, changed, recording
from torchrl_h2o.effects import ActionNoise, ObservationDelay
from torchrl_h2o.residuals.offered import offered_entries


def filtered(rows: np.ndarray) -> np.ndarray:
    """Velocities through a first-order filter with a time constant of one row."""
    for row in range(1, len(rows)):
        rows[row, 2:] = rows[row - 1, 2:] + 0.63 * (rows[row, 2:] - rows[row - 1, 2:])
    return rows


@pytest.mark.parametrize(
    ("data", "late"),
    [
        (recording(noise=0.0), False),
        (recording(noise=0.01), False),
        (recording(ActionNoise(0.2), noise=0.0), False),
        (changed(recording(noise=0.0), filtered), True),
    ],
)
def test_velocities_may_be_late_if_the_positions_show_it(data, late):
    delays = [
        entry.effect.entries for entry in offered_entries(arm(), data) if isinstance(entry.effect, ObservationDelay)
    ]
    assert delays == ([None, (2, 3)] if late else [None])
