"""Unobserved coordinates: the robot's height and vertical velocity, simulated from some rows before."""

from dataclasses import replace

import numpy as np
import pytest

from torchrl_h2o.effects import ActionDelay
from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation, residuals
from torchrl_h2o.residuals.measured.residual import start_states
from torchrl_h2o.residuals.measured.settling import _chains
from torchrl_h2o.residuals.settings import DEFAULTS

LONG = replace(DEFAULTS.measured, settling_steps=48, settled_rows=100)  # successive rows share simulations


@pytest.fixture(scope="module")
def simulation():
    return Simulation.from_env(WheelLeggedEnv())


@pytest.fixture(scope="module")
def measured(simulation):
    """Three runs of 200 rows."""
    env = WheelLeggedEnv(max_episode_steps=200)
    recorded = record(env, noisy_balance_controller(), 600, seed=0)
    return Measured.from_ted(recorded, simulation, settings=LONG)


def settled(simulation, measured, rows, **settings):
    measured = replace(measured, settings=replace(measured.settings, **settings))
    return start_states(simulation, measured, rows)[np.ix_(rows, np.asarray(simulation.state_map.hidden))]


@pytest.mark.parametrize("effects", [(), (ActionDelay(0.01),)], ids=["plain", "with effects"])
def test_rows_that_share_a_simulation_are_settled_as_if_each_had_its_own(simulation, measured, effects):
    simulation = simulation.with_effects(*effects)
    rows = np.concatenate([np.arange(60, 190), np.arange(470, 560, 7)])
    alone = settled(simulation, measured, rows, settled_rows=1, settling_steps=100)
    together = settled(simulation, measured, rows)
    assert np.median(np.abs(together - alone), axis=0) == pytest.approx(0.0, abs=1e-5)


def test_rows_may_come_in_any_order_and_more_than_once(simulation, measured):
    rows = np.array([150, 70, 150, 71])
    sorted_rows = settled(simulation, measured, np.array([70, 71, 150]))
    assert np.array_equal(settled(simulation, measured, rows), sorted_rows[[2, 0, 2, 1]])


def test_more_steps_before_a_row_make_its_residual_smaller(simulation, measured):
    rows = np.arange(60, 190)
    few, many = (replace(measured, settings=replace(LONG, settled_rows=1, settling_steps=steps)) for steps in (3, 48))
    small, large = (np.median(np.abs(residuals(simulation, data, rows)), axis=(0, 1)) for data in (many, few))
    assert (small < 0.2 * large).all()


def test_after_a_divergence_later_rows_settle_anew(simulation, measured):
    observation = measured.observation.copy()
    observation[80] = 1e30
    broken = replace(measured, observation=observation)
    rows = np.arange(60, 190)
    states = settled(simulation, broken, rows)
    assert np.isfinite(states).all()
    assert states[-60:] == pytest.approx(settled(simulation, measured, rows)[-60:], abs=1e-4)


def test_a_simulation_is_for_near_rows_of_one_run_and_not_for_many():
    begins = np.repeat([0, 200, 400], 200)
    steps, most = LONG.settling_steps, LONG.settled_rows
    rows = np.array([0, 1, 1 + steps, 100, 199, 200, 210, 210 + steps + 1, *range(400, 400 + 2 * most)])
    first, last = _chains(rows, begins, LONG)
    assert first.tolist() == [0, 100, 199, 200, 210 + steps + 1, 400, 400 + most]
    assert last.tolist() == [1 + steps, 100, 199, 210, 210 + steps + 1, 399 + most, 399 + 2 * most]


def test_no_rows_need_no_simulation(simulation, measured):
    assert settled(simulation, measured, np.zeros(0, int)).shape == (0, 2)
