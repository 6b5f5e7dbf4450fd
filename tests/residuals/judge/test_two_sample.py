"""The two-sample test: AUC 0.5 without a gap, higher under another gravity, unaffected by sensor noise."""

import pytest
import torch

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import Gravity
from torchrl_h2o.residuals import LoopSettings, two_sample_auc

SIMULATION = pendulum()
QUICK = LoopSettings(classifier_updates=150)


@pytest.mark.slow
def test_no_gap_is_seen_in_data_of_the_very_same_simulator():
    assert two_sample_auc(SIMULATION, recorded(SIMULATION)) == pytest.approx(0.5, abs=0.1)


def test_a_gap_is_seen():
    assert two_sample_auc(SIMULATION, recorded(SIMULATION.with_effects(Gravity(3.0))), settings=QUICK) > 0.7


@pytest.mark.slow
def test_noise_of_the_sensors_is_no_gap_once_it_is_simulated_too():
    measured = recorded(SIMULATION, 3000, noise=0.05)
    sensor_std = 0.05 * recorded(SIMULATION, 3000).observation.std(0)
    with_noise, without = (two_sample_auc(SIMULATION, measured, sensor_std=std) for std in (sensor_std, None))
    assert with_noise == pytest.approx(0.5, abs=0.08)
    assert without > with_noise + 0.05


@pytest.mark.slow
def test_the_same_seed_gives_the_same_and_leaves_the_random_state_alone():
    measured = recorded(SIMULATION.with_effects(Gravity(2.0)), 400)
    before = torch.get_rng_state()
    one, same = (two_sample_auc(SIMULATION, measured, seed=3, settings=QUICK) for _ in range(2))
    assert one == same
    assert torch.equal(before, torch.get_rng_state())
