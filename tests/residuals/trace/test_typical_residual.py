"""Explanations compared by their typical residuals, which a few large ones do not hide."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import JointFrictionLoss, RollingResistance
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.trace.eliminate import eliminate
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState
from torchrl_h2o.residuals.trace.typical_residual import is_finer, leaves_much_finer

LEVEL = 0.01
DRY, ROLLING = JointFrictionLoss(0.12, joints="axle"), RollingResistance(0.003, geoms="*_wheel")
INSTEAD = JointFrictionLoss(0.37, joints="axle")  # the dry friction that makes up for a missing rolling resistance


def fit_of(*effects):
    return Fit(effects, ((),) * len(effects), 0.0, ({},) * len(effects))


def begun(simulation, measured, catalogue=()):
    return SearchState.begin(Problem.pose(simulation, measured), catalogue, np.random.default_rng(0))


@pytest.fixture(scope="module")
def robot():
    """The search in data of a robot with dry friction and rolling resistance; its height is not observed."""
    simulation = Simulation.from_env(WheelLeggedEnv())
    reality = TransformedEnv(WheelLeggedEnv(max_episode_steps=1000), DynamicsGap(DRY, ROLLING))
    measured = Measured.from_ted(record(reality, noisy_balance_controller(), 2000, seed=0), simulation)
    names = {"JointFrictionLoss axle", "RollingResistance *wheel*"}
    return begun(simulation, measured, [entry for entry in simulation.catalogue() if entry.name in names])


def test_the_right_effects_leave_a_much_finer_residual_than_a_makeshift(robot):
    assert leaves_much_finer(robot, fit_of(DRY, ROLLING), fit_of(INSTEAD), LEVEL)
    assert not leaves_much_finer(robot, fit_of(INSTEAD), fit_of(DRY, ROLLING), LEVEL)


def test_a_little_less_residual_is_not_much_finer(robot):
    near, far = (fit_of(DRY.with_parameters({"torque": torque}), ROLLING) for torque in (0.13, 0.14))
    assert not leaves_much_finer(robot, near, far, LEVEL)


def test_where_all_coordinates_are_observed_the_robust_loss_decides_alone():
    simulation = pendulum()
    friction = JointFrictionLoss(0.05)
    state = begun(simulation, recorded(simulation.with_effects(friction), 500))
    finer, coarser = (state.posed_at(effects) for effects in ((friction,), ()))
    assert is_finer(finer, coarser, state.settings.trace.much_finer)
    assert not leaves_much_finer(state, fit_of(friction), fit_of(), LEVEL)


def test_an_effect_that_makes_the_typical_residual_much_finer_is_not_eliminated(robot):
    """Also where its share of the whole reduction of the robust loss is within rounding, as next to hops of a wheel."""
    entries = sorted(robot.catalogue, key=lambda entry: entry.name, reverse=True)
    found = robot.with_found(entries, robot.refitted(entries, [ROLLING, DRY]))
    assert "RollingResistance *wheel*" in {entry.name for entry in eliminate(replace(found, first_loss=1e12)).entries}
