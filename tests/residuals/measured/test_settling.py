"""The robot's height and the speed of its wheels are not observed; a simulation along the data reaches them."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from tests.residuals.pendulum import double_pendulum, pendulum, recorded
from torchrl_h2o.effects import GearPlay, LoadFriction, RollingResistance
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.measured.residual import residuals, start_states
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import SETTLING_STEPS, thinned

ROWS = 600
HOPS = RollingResistance(0.003, geoms="*_wheel")  # its wheels lift off and land again


@pytest.fixture(scope="module")
def hopping():
    """A recorded robot whose wheels hop, and its simulation."""
    env = TransformedEnv(WheelLeggedEnv(max_episode_steps=ROWS), DynamicsGap(HOPS))
    simulation = Simulation.from_env(env)
    return simulation, Measured.from_ted(record(env, noisy_balance_controller(), ROWS, seed=0), simulation)


def error(simulation, measured, states):
    rows = measured.fitted()
    change = (measured.following - measured.observation)[rows].std(0)
    return np.abs(residuals(simulation, measured, rows, states=states)[:, 0]).mean(0) / change


def test_hops_are_simulated_as_they_were_measured(hopping):
    simulation, measured = hopping
    settled = start_states(simulation, measured, measured.fitted())
    rolling = settled.copy()
    rolling[:, 7] = simulation.state_map.states(measured.observation)[:, 7]
    assert error(simulation, measured, settled).max() < 1e-4
    assert error(simulation, measured, rolling).max() > 5e-3


def test_a_row_settles_alike_alone_and_among_others(hopping):
    simulation, measured = hopping
    hidden, row = list(simulation.state_map.hidden), 300
    alone, among = (
        start_states(simulation, measured, rows)[row, hidden] for rows in (np.array([row]), np.arange(ROWS))
    )
    np.testing.assert_allclose(alone, among, atol=1e-4)


def test_the_first_rows_of_a_run_are_left_out_at_most_a_quarter(hopping):
    _, measured = hopping
    assert not measured.usable[measured.run == 0][:SETTLING_STEPS].any()
    short = replace(measured, run=np.arange(ROWS) // 40)
    assert short.run_beginnings().sum() == 10 * len(short.runs)


def test_windows_are_thinned_in_blocks_of_neighbours():
    kept = thinned(np.arange(1000), 100, block=25)
    assert len(kept) == 100
    assert (np.diff(kept) == 1).sum() == 4 * 24
    assert kept[0] == 0
    assert kept[-1] == 999


def test_teeth_of_a_gear_are_where_the_log_has_brought_them():
    """Each window begins with them as a simulation along the log leaves them, so no error is left but at its begin."""
    simulation = pendulum().with_effects(LoadFriction(0.01), GearPlay(0.3))
    measured = recorded(simulation, 800)
    rows = np.arange(100, 700)
    known = np.abs(residuals(simulation, measured, rows, 4)[:, -1, 0])
    states = start_states(simulation, measured, rows)
    actions = measured.action[rows[:, None] + np.arange(4)]
    reached = simulation.rollout(states[rows], actions, time=measured.time[rows])[:, -1, 0]
    unknown = np.abs(measured.following[rows + 3, 0] - reached)
    assert (unknown > 0.01).mean() > 0.05
    assert (known > 0.01).mean() < 0.2 * (unknown > 0.01).mean()


def test_teeth_follow_the_velocities_of_the_log_where_no_sensor_reads_them():
    whole = pendulum().with_effects(GearPlay(0.3))
    measured, rows = recorded(pendulum(), 400), np.arange(100, 300)
    positions = replace(whole, state_map=replace(whole.state_map, hidden=(1,)))
    states = whole.state_map.states(measured.observation)
    known, read = (activations(one, measured, measured.action, states, rows)[rows] for one in (positions, whole))
    np.testing.assert_allclose(known, read, atol=1e-12)


def test_each_gear_remembers_its_own_teeth():
    """Play that two effects give to two motors is the play that one effect gives to both."""
    gears = (), (GearPlay(0.2),), (GearPlay(0.2, (0,)), GearPlay(0.2, (1,)))
    none, both, each = (double_pendulum().with_effects(*own) for own in gears)
    measured, rows = recorded(none, 600), np.arange(100, 500)
    assert both.num_remembered == each.num_remembered == 6
    errors = [residuals(simulation, measured, rows, 4) for simulation in (both, each)]
    np.testing.assert_allclose(*errors, atol=1e-12)
    assert (np.abs(errors[0][:, -1]).max(0) > 0.01).all()
