"""Measured transitions, simulated once more: the same next observations if the simulator equals reality."""

from functools import cache

import pytest
import torch
from torchrl.envs import TransformedEnv

from torchrl_h2o.effects import ActionDelay, ActionNoise, BodyMass, ObservationDelay, ObservationNoise
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Simulation, simulate_transitions
from torchrl_h2o.residuals.measured.transitions import SETTLING_STEPS

ROWS, SETTLING = 300, SETTLING_STEPS


def robot(*effects):
    return TransformedEnv(WheelLeggedEnv(), DynamicsGap(*effects))


@cache
def recording(*effects):
    """A run of the robot with effects."""
    return record(robot(*effects), noisy_balance_controller(), ROWS, seed=0, progress=False)


def error_of(real_effects, sim_effects, seed=0):
    real = recording(*real_effects)
    following = simulate_transitions(Simulation.from_env(robot(*sim_effects)), real, seed=seed)
    return following - real["next", "observation"]


def test_equal_dynamics_with_a_delay_give_the_measured_next_observation():
    delay = ActionDelay(0.0125)
    same, without = error_of([delay], [delay]), error_of([delay], [])
    assert same[:SETTLING].isnan().all()  # the wheels' speed in the first rows is not known
    assert same[SETTLING:].abs().max() < 1e-3
    assert without[SETTLING:].abs().max() > 0.1


def test_another_mass_gives_another_next_observation():
    assert error_of([], [BodyMass(1.5, bodies=("torso",))])[SETTLING:].abs().max() > 0.05


def test_sensor_noise_is_on_both_ends_of_a_simulated_transition():
    noise = ObservationNoise(0.05, entries=(2,))  # of the displacement, which moves by little in one step
    of_sim = error_of([], [noise])[SETTLING:, 2]
    of_both = error_of([noise], [noise])[SETTLING:, 2]
    assert of_sim.std().item() == pytest.approx(0.05 * 2**0.5, rel=0.15)
    assert of_both.std().item() == pytest.approx(0.05 * 4**0.5, rel=0.15)


def test_random_effects_repeat_with_their_seed():
    noise = ActionNoise(0.3)
    one, same, other = (error_of([], [noise], seed).nan_to_num() for seed in (0, 0, 1))
    assert torch.equal(one, same)
    assert (one != other).any()


def test_a_delay_of_single_sensors_is_refused():
    with pytest.raises(ValueError, match="single sensors"):
        error_of([], [ObservationDelay(0.01, entries=(0,))])
