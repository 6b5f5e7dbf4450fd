"""Disturbances from outside: pushes are found, and missing effects are not mistaken for pushes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.residuals.pendulum import three_parts
from torchrl_h2o.effects import Gravity, JointFrictionLoss, JointRange
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.measured.outside import outside_intervals, outside_rows

PENDULUM = Path(__file__).parents[3] / "recipes" / "models" / "simple_pendulum.xml"
ROWS = 3000
PUSHES = ((700, 730), (1900, 1925), (2500, 2530))  # rows


@pytest.fixture(scope="module")
def simulation():
    return Simulation.from_mjcf(PENDULUM, ["hinge", "hinge_velocity"], 0.005)


def swings(simulation, pushes=(), noise=1e-3, torque=1.0):
    """A swinging pendulum, driven by a slow random torque and pushed by 3 N·m."""
    rng = np.random.default_rng(0)
    time = 0.005 * np.arange(ROWS)
    action = torque * (0.8 * np.sin(2.9 * time) + 0.5 * np.sin(4.1 * time + 1.0))[:, None]
    force = np.zeros((1, ROWS, 1))
    for start, stop in pushes:
        force[:, start:stop] = 3.0
    reached = simulation.rollout(np.array([[0.4, 0.0]]), action[None], applied=force)[0]
    whole = np.vstack([[0.4, 0.0], reached]) + noise * rng.standard_normal((ROWS + 1, 2))
    return Measured(
        whole[:-1], action, whole[1:], np.zeros(ROWS, int), time, np.ones(ROWS, bool), three_parts(ROWS), {}, "swings"
    )


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_pushes_are_found_and_little_else(simulation, friction):
    reality = simulation.with_effects(JointFrictionLoss(friction))
    mask = outside_rows(outside_intervals(simulation, swings(reality, PUSHES)), ROWS)
    pushed = outside_rows([], ROWS)
    for start, stop in PUSHES:
        pushed[start:stop] = True
    assert mask[pushed].all()
    assert mask.mean() < 2.5 * pushed.mean()


@pytest.mark.parametrize(
    "effects",
    [(), (Gravity(1.3),), (JointFrictionLoss(0.2),)],
    ids=["nothing", "gravity", "friction"],
)
def test_what_the_simulator_lacks_is_no_push(simulation, effects):
    intervals = outside_intervals(simulation, swings(simulation.with_effects(*effects)))
    assert outside_rows(intervals, ROWS).mean() < 0.01


def stopped(directory, quantile):
    """Data of a pendulum with a stop inside its swing; in the simulator the stop is further away."""
    path = directory / "stopped.xml"
    path.write_text(PENDULUM.read_text().replace('name="hinge" type', 'name="hinge" range="-3 3" type'))
    simulation = Simulation.from_mjcf(path, ["hinge", "hinge_velocity"], 0.005)
    free = swings(simulation, torque=0.3)
    furthest = float(np.quantile(np.abs(free.observation[:, 0]), quantile))
    data = swings(simulation.with_effects(JointRange(furthest / 3.0)), torque=0.3)
    assert np.abs(data.observation[:, 0]).max() < np.abs(free.observation[:, 0]).max()
    return simulation, data, np.abs(data.observation[:, 0]) > furthest - 0.02


def test_a_limit_that_is_hit_again_and_again_is_no_push(tmp_path):
    simulation, data, _ = stopped(tmp_path, 0.7)
    assert outside_rows(outside_intervals(simulation, data), ROWS).mean() < 0.01


def test_a_limit_that_is_hit_twice_in_held_out_rows_is_set_aside_there_and_nowhere_else(tmp_path):
    """Two events do not count as recurring, and effects may not be fitted to held-out rows."""
    simulation, data, at_the_stop = stopped(tmp_path, 0.97)
    assert data.held_out[at_the_stop].all()
    intervals = outside_intervals(simulation, data)
    assert len(intervals) == 2
    assert all(at_the_stop[interval.start : interval.stop].any() for interval in intervals)


def test_intervals_end_where_their_runs_do(simulation):
    data = swings(simulation, ((1490, 1500),))
    data = replace(data, run=(np.arange(ROWS) >= 1500).astype(int))
    (interval,) = outside_intervals(simulation, data)
    assert interval.start < 1490
    assert interval.stop == 1500
    assert interval.size > 12.0


def test_too_few_rows_have_no_intervals(simulation):
    data = swings(simulation, PUSHES)
    assert outside_intervals(simulation, replace(data, usable=np.arange(ROWS) < 15)) == []
