"""Intervals are as wide as the scatter of fitted values."""

from types import SimpleNamespace

import numpy as np
import pytest

from torchrl_h2o.likelihood import TAIL
from torchrl_h2o.residuals.intervals import CONFIDENCE, spreads_of
from torchrl_h2o.residuals.whitened import weights

BLOCKS, ROWS = 40, 25


def mean_of(errors: np.ndarray) -> float:
    """The likeliest mean of errors whose scale is known, (N,)."""
    value = 0.0
    for _ in range(50):
        value += float(np.average(errors - value, weights=weights(errors - value)))
    return value


@pytest.mark.parametrize(
    "draw",
    [np.random.Generator.standard_normal, lambda rng, size: rng.standard_t(TAIL, size) / np.sqrt(TAIL / (TAIL - 2.0))],
    ids=["normal errors", "errors with the tails of the score"],
)
def test_an_interval_is_as_wide_as_the_scatter_of_the_fitted_value(draw):
    rng = np.random.default_rng(0)
    windows = SimpleNamespace(block=np.repeat(np.arange(BLOCKS), ROWS), horizons=np.ones(1))

    class Blocks(SimpleNamespace):
        def __len__(self) -> int:
            return BLOCKS

    blocks = Blocks(windows=[windows], first=np.arange(BLOCKS))
    record = SimpleNamespace(num_readings=1, measured=SimpleNamespace(log=None))
    part = SimpleNamespace(blocks=blocks, record=record)
    values, halves = [], []
    for _ in range(300):
        errors = draw(rng, BLOCKS * ROWS)
        value, ones = mean_of(errors), np.ones(len(errors))
        found = spreads_of([part], [(errors - value, ones, ones)], [np.ones((len(errors), 1))], lambda _, own=ones: own)
        values.append(value)
        halves.append(found.half_widths[0])
    assert np.mean(halves) == pytest.approx(CONFIDENCE * np.std(values), rel=0.12)
