"""Audits of a body that moves freely: its quaternion, its angular velocities, and its velocity."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.data.audit.recorded import measured
from torchrl_h2o.data import audit
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.simulation.state_map import coordinate_names

XML = """
<mujoco model="body">
  <option timestep="0.005"/>
  <worldbody>
    <body name="body">
      <freejoint name="root"/>
      <geom type="box" size="0.1 0.15 0.05" mass="1" contype="0" conaffinity="0"/>
      <site name="hub"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="thrust" site="hub" gear="0 0 1 0 0 0"/>
    <motor name="roll" site="hub" gear="0 0 0 1 0 0"/>
    <motor name="pitch" site="hub" gear="0 0 0 0 1 0"/>
    <motor name="yaw" site="hub" gear="0 0 0 0 0 1"/>
  </actuator>
</mujoco>
"""
PLACE, QUATERNION, VELOCITY, RATES = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)


@pytest.fixture(scope="module")
def simulation():
    names, units = coordinate_names(mujoco.MjModel.from_xml_string(XML))
    state_map = StateMap.of_coordinates(tuple(names), tuple(units), range(13), num_states=13)
    return Simulation(lambda: mujoco.MjSpec.from_string(XML), 2, state_map, name="body")


@pytest.fixture(scope="module")
def flight(simulation):
    """Rows (T + 1, 13) and actions (T, 4) of a body that turns about all axes, with a little noise."""
    rng = np.random.default_rng(0)
    action = np.zeros((800, 4))
    for row in range(1, len(action)):
        action[row] = 0.9 * action[row - 1] + np.array([1.0, 0.01, 0.01, 0.01]) * rng.standard_normal(4)
    action[:, 0] += 9.81
    start = np.zeros(13)
    start[3] = 1.0
    rows = np.vstack([start, simulation.rollout(start[None], action[None])[0]])
    rows += np.repeat([0.002, 0.001, 0.01, 0.02], [3, 4, 3, 3]) * rng.standard_normal(rows.shape)
    rows[:, QUATERNION] /= np.linalg.norm(rows[:, QUATERNION], axis=1, keepdims=True)
    return rows, action


def turned(rows):
    return Rotation.from_quat(rows[:, QUATERNION], scalar_first=True)


def of_kinematics(rows, action, simulation):
    found = audit(measured(rows, action), simulation)
    return [finding.words for finding in (*found.severe, *found.warnings) if finding.check == "kinematics"]


def test_a_sound_flight_has_no_findings(flight, simulation):
    assert audit(measured(*flight), simulation).severe == ()
    assert of_kinematics(*flight, simulation) == []


def test_noise_on_the_quaternion_with_which_an_episode_begins_is_no_finding(flight, simulation):
    """Gymnasium's Ant begins so; MuJoCo makes it a unit quaternion in the first step."""
    rows = flight[0].copy()
    rows[0, QUATERNION] *= 0.92
    assert of_kinematics(rows, flight[1], simulation) == []


def in_degrees(rows):
    rows[:, RATES] *= 180.0 / np.pi


def in_the_world(rows):
    rows[:, RATES] = turned(rows).apply(rows[:, RATES])


def scalar_last(rows):
    rows[:, QUATERNION] = rows[:, [4, 5, 6, 3]]


def inverted(rows):
    rows[:, 4:7] *= -1.0


def exchanged(rows):
    rows[:, [10, 11]] = rows[:, [11, 10]]


def reversed_yaw(rows):
    rows[:, 12] *= -1.0


def flipped(rows):
    rows[300:500, QUATERNION] *= -1.0


def scaled(rows):
    rows[:, QUATERNION] *= 2.0


def of_odometry(rows):
    rows[:, VELOCITY] = turned(rows).inv().apply(rows[:, VELOCITY])


def of_another_flight(rows):
    rows[:, RATES] = rows[::-1, RATES].copy()


def lost(rows):
    rows[100:110, QUATERNION] = 0.0


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (in_degrees, "the angular velocities of root look like degrees per second"),
        (in_the_world, "the angular velocities of root are in the axes of the world"),
        (scalar_last, "the quaternion of root is in the order x, y, z, w"),
        (inverted, "the quaternion of root is inverted"),
        (exchanged, "as if the angular velocities were about x root_pitch_velocity, about y root_roll_velocity"),
        (reversed_yaw, "about z minus root_yaw_velocity"),
        (flipped, "the quaternion of root changes its sign"),
        (scaled, "their norm is 2"),
        (of_odometry, "the velocity of root is in the axes of the body"),
        (lost, "in 1.4% of the rows, the four numbers of root are no unit quaternion: their norm is 0"),
        (of_another_flight, "are not the derivative of its quaternion"),
    ],
)
def test_a_fault_of_a_free_body_s_columns_is_named(flight, simulation, damage, words):
    rows, action = flight[0].copy(), flight[1]
    damage(rows)
    found = audit(measured(rows, action), simulation)
    named = found.warnings if damage in (of_another_flight, lost) else found.severe
    assert any(words in finding.words for finding in named), found.words()


def test_a_body_that_hardly_turns_is_not_judged(simulation):
    rng = np.random.default_rng(0)
    rows = np.zeros((400, 13))
    rows[:, 3] = 1.0
    rows += 0.001 * rng.standard_normal(rows.shape)
    found = of_kinematics(rows, np.full((399, 4), [9.81, 0.0, 0.0, 0.0]), simulation)
    assert not any("quaternion" in words or "axes" in words for words in found), found


def test_a_gyroscope_that_is_late_against_the_quaternion_is_a_warning(simulation):
    time = 0.01 * np.arange(800)
    rows = np.zeros((800, 13))
    angle = 0.3 * np.sin(20.0 * time)
    rows[:, 3], rows[:, 4], rows[:, 10] = np.cos(0.5 * angle), np.sin(0.5 * angle), 6.0 * np.cos(20.0 * (time - 0.04))
    found = audit(measured(rows, np.full((799, 4), [9.81, 0.0, 0.0, 0.0])), simulation)
    words = "the angular velocities of root are 4 rows late against its quaternion"
    assert any(words in finding.words for finding in found.warnings), found.words()


@pytest.mark.parametrize("kind", ["bias", "vibration"])
def test_a_gyroscope_s_bias_and_vibration_are_no_severe_fault_of_a_body_that_hardly_turns(simulation, kind):
    time, rng = 0.01 * np.arange(800), np.random.default_rng(0)
    angle = 0.02 * np.sin(2.0 * time)
    rows = np.zeros((800, 13))
    rows[:, 3], rows[:, 4], rows[:, 10] = np.cos(0.5 * angle), np.sin(0.5 * angle), 0.04 * np.cos(2.0 * time)
    rows[:, RATES] += 0.02 if kind == "bias" else 0.1 * rng.standard_normal((800, 3))
    found = audit(measured(rows, np.full((799, 4), [9.81, 0.0, 0.0, 0.0])), simulation)
    assert not any("angular" in finding.words or "quaternion" in finding.words for finding in found.severe)


def test_a_body_without_angular_velocities_is_named(flight, simulation):
    names, units = simulation.state_map.names[:10], simulation.state_map.units[:10]
    state_map = replace(StateMap.of_coordinates(names, units, range(10), num_states=13), hidden=(10, 11, 12))
    found = audit(measured(flight[0][:, :10], flight[1]), replace(simulation, state_map=state_map))
    assert any("no angular velocity is given for root" in finding.words for finding in found.warnings)
