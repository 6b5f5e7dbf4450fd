"""Logs that are sound though little happens in them, and logs that are no data at all."""

import mujoco
import numpy as np
import pytest

from tests.data.audit.recorded import measured, rows_of, with_action
from torchrl_h2o.data import DataError, audit
from torchrl_h2o.residuals import Simulation, StateMap

BODY = """<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint name="body"/>
<geom type="box" size="0.1 0.2 0.3" mass="1"/></body></worldbody></mujoco>"""
SPIN = {"still": (0.0, 0.0, 0.0), "turning": (0.0, 0.0, 0.7)}


def drifting(spin) -> tuple[np.ndarray, Simulation]:
    """Rows of a free body at constant velocities, and its simulation every 10 ms."""
    names = [f"p{axis}" for axis in "xyz"] + [f"q{axis}" for axis in "wxyz"]
    names += [f"v{axis}" for axis in "xyz"] + [f"r{axis}" for axis in "xyz"]
    units = ["m"] * 3 + ["1"] * 4 + ["m/s"] * 3 + ["rad/s"] * 3
    state_map = StateMap.of_coordinates(tuple(names), tuple(units), tuple(range(13)), num_states=13)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(BODY), 5, state_map, (), "body")
    start = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.3, -0.2, 0.0, *spin])
    return np.vstack([start, simulation.rollout(start[None], np.zeros((1, 300, 0)))[0]]), simulation


@pytest.mark.parametrize("spin", SPIN)
def test_a_free_body_at_constant_velocity_is_not_frozen(spin):
    rows, simulation = drifting(SPIN[spin])
    assert audit(measured(rows, np.zeros((300, 0))), simulation).severe == ()


@pytest.mark.parametrize(("columns", "stuck"), [([7], 0.0), ([12], 0.0), ([3, 4, 5, 6], None)])
def test_sensors_of_a_free_body_that_stand_still_are_frozen(columns, stuck):
    rows, simulation = drifting(SPIN["turning"])
    rows[50:, columns] = rows[50, columns] if stuck is None else stuck
    words = [finding.words for finding in audit(measured(rows, np.zeros((300, 0))), simulation).severe]
    assert any("is frozen" in each for each in words)


@pytest.mark.parametrize("rows", [2, 5, 19])
def test_few_good_rows_have_no_severe_finding(good, simulation, rows):
    assert audit(measured(rows_of(good)[: rows + 1], good.action[:rows]), simulation).severe == ()


@pytest.mark.parametrize("mass", [0.3, 1.0])
def test_log_of_a_double_integrator_is_no_pendulum_with_rotors(mass):
    xml = """<mujoco><option timestep="0.005"/><worldbody><body><joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/></body></worldbody>
    <actuator><motor joint="hinge"/></actuator></mujoco>"""
    state_map = StateMap.of_coordinates(("q", "q_velocity"), ("rad", "rad/s"), (0, 1), num_states=2)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(xml), 2, state_map, (), "pendulum")
    rng, state, rows, action = np.random.default_rng(0), np.zeros(2), [np.zeros(2)], []
    for _ in range(1000):
        action.append([-0.8 * state[0] - 0.5 * state[1] + 0.6 * rng.standard_normal()])
        velocity = state[1] + 0.01 * action[-1][0] / mass
        state = np.array([state[0] + 0.01 * velocity, velocity])
        rows.append(state)
    found = audit(measured(np.array(rows), np.array(action)), simulation)
    assert not [finding for finding in found.findings if "far better with rotors" in finding.words]
    serious = [*found.severe, *found.warnings]
    assert any("another robot" in finding.words for finding in serious), found.words()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_with_their_place(good, simulation, value):
    action = good.action.copy()
    action[7, 1] = value
    with pytest.raises(DataError, match=f"row 7 of m2 is {value}"):
        audit(with_action(good, action), simulation)


def test_what_is_no_transitions_is_refused(simulation):
    with pytest.raises(DataError, match="an audit needs transitions, not str"):
        audit("log.csv", simulation)


def test_actions_of_later_rows_reach_the_end_of_the_log(good, simulation):
    """Windows at the end have no later action to look at."""
    found = audit(measured(rows_of(good)[3:], good.action[:-3]), simulation)
    assert any("3 rows (30 ms) earlier" in finding.words for finding in found.severe), found.words()
