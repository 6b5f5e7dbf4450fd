"""Autocorrelation of the remaining residual: about zero where only noise remains."""

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionNoise, BodyMass, Gravity
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.judge.whiteness import autocorrelation

SIMULATION = pendulum()


@pytest.mark.slow
def test_noise_of_the_action_leaves_a_white_residual():
    measured = recorded(SIMULATION.with_effects(ActionNoise(0.3)), 4000)
    np.testing.assert_allclose(autocorrelation(SIMULATION, measured), 0.0, atol=0.1)


def test_what_the_simulator_lacks_goes_on():
    assert (autocorrelation(SIMULATION, recorded(SIMULATION.with_effects(Gravity(1.5)), 2000)) > 0.8).all()


@pytest.mark.slow
def test_what_noise_of_the_sensors_adds_it_takes_off_again():
    found = autocorrelation(SIMULATION, recorded(SIMULATION, 4000, noise=0.02))
    assert ((found > -0.6) & (found < -0.3)).all()


def test_rounding_is_no_residual():
    assert np.isnan(autocorrelation(SIMULATION, recorded(SIMULATION, 500))).all()


def test_without_neighbours_there_is_none():
    assert np.isnan(autocorrelation(SIMULATION, recorded(SIMULATION.with_effects(Gravity(1.5)), 4))).all()


def robot(*effects):
    """Autocorrelation of the residuals of a robot's simulator in data of the same robot with effects."""
    simulation = Simulation.from_env(WheelLeggedEnv())
    reality = TransformedEnv(WheelLeggedEnv(), DynamicsGap(*effects))
    return autocorrelation(
        simulation, Measured.from_ted(record(reality, noisy_balance_controller(), 500, seed=0), simulation)
    )


@pytest.mark.slow
def test_an_unobserved_coordinate_is_no_residual():
    """The estimated height of the robot is wrong by a little, and for several steps."""
    assert np.isnan(robot()).all()
    assert np.isfinite(robot(BodyMass(1.05, bodies="torso"))).all()
