"""Columns without names, of which there are more than the model has coordinates and actuators."""

import re

import numpy as np
import pytest

from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates

UNITS = {"hip": "rad", "knee": "rad", "hip_velocity": "rad/s", "knee_velocity": "rad/s"}
MOTORS = Coordinates(UNITS, ["hip_motor", "knee_motor"])
RNG = np.random.default_rng(0)
TIME = 12.0 + 0.01 * np.arange(1000)
RATES = np.array([1.3, 2.1])
Q = np.sin(TIME[:, None] * RATES)
V = RATES * np.cos(TIME[:, None] * RATES)
TORQUE = 3.0 * np.sin(TIME[:, None] * [0.7, 3.9])
OTHER = RNG.standard_normal((1000, 3))
ZERO = np.zeros((1000, 2))
ACCELERATION = -(RATES**2) * Q


def roles(tmp_path, *columns, model=MOTORS) -> dict[int, tuple[str, str]]:
    """Name and role of each column that is not ignored, by its index."""
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",")
    found = re.findall(r'name: "(\w+)", role: (\w+)', guess_layout(path, model))
    return {index: entry for index, entry in enumerate(found) if entry[1] != "ignore"}


def expected(time, positions, velocities, actions) -> dict[int, tuple[str, str]]:
    observed = dict(zip((*positions, *velocities), UNITS, strict=True))
    return (
        {time: ("time", "time")}
        | {index: (name, "observation") for index, name in observed.items()}
        | {index: (name, "action") for index, name in zip(actions, MOTORS.actuators, strict=True)}
    )


def test_blocks_of_positions_velocities_and_torques_are_found_among_others(tmp_path):
    found = roles(tmp_path, OTHER, TIME, Q, V, TORQUE, OTHER)
    assert found == expected(3, (4, 5), (6, 7), (8, 9))


def test_a_velocity_may_stand_beside_its_position(tmp_path):
    pairs = np.stack([Q, V], axis=2).reshape(len(TIME), 4)
    assert roles(tmp_path, TIME, OTHER, pairs, TORQUE) == expected(0, (4, 6), (5, 7), (8, 9))


def test_the_time_need_not_be_regular(tmp_path):
    shaken = TIME + 0.002 * RNG.uniform(-1.0, 1.0, len(TIME))
    q, v = np.sin(shaken[:, None] * RATES), RATES * np.cos(shaken[:, None] * RATES)
    assert roles(tmp_path, shaken, q, v, TORQUE, OTHER) == expected(0, (1, 2), (3, 4), (5, 6))


def test_accelerations_constants_and_copies_are_no_commands(tmp_path):
    found = roles(tmp_path, TIME, TORQUE, Q, V, ZERO, Q + 1e-3 * OTHER[:, :2])
    assert found == expected(0, (3, 4), (5, 6), (1, 2))
    assert roles(tmp_path, TIME, Q, V, ACCELERATION, TORQUE) == expected(0, (1, 2), (3, 4), (7, 8))


def test_velocities_and_accelerations_are_not_taken_for_positions_and_velocities(tmp_path):
    assert roles(tmp_path, TIME, V, Q, ACCELERATION, TORQUE) == expected(0, (3, 4), (1, 2), (7, 8))


def test_of_two_commands_one_may_rest_or_follow_a_state(tmp_path):
    for quiet in (0.0 * TIME, 2.0 * Q[:, 0]):
        found = roles(tmp_path, TIME, Q, V, np.column_stack([quiet, TORQUE[:, 1]]), OTHER)
        assert found == expected(0, (1, 2), (3, 4), (5, 6))


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("ns", 1e9)])
def test_the_time_has_the_unit_that_its_step_suggests(tmp_path, unit, factor):
    counter = np.arange(len(TIME))
    columns = [counter, np.round(factor * TIME), Q, V, TORQUE]
    assert roles(tmp_path, *columns) == expected(1, (2, 3), (4, 5), (6, 7))
    assert f'role: time, unit: "{unit}"' in guess_layout(tmp_path / "log.csv", MOTORS)


def test_columns_that_drift_are_no_clocks_and_repeated_rows_are_no_fault_of_a_clock(tmp_path):
    drift = np.cumsum(RNG.exponential(1.0, len(TIME)) ** 3)
    repeated = TIME.copy()
    repeated[::20] = repeated[1::20]
    q, v = np.sin(repeated[:, None] * RATES), RATES * np.cos(repeated[:, None] * RATES)
    assert roles(tmp_path, drift, repeated, q, v, TORQUE) == expected(1, (2, 3), (4, 5), (6, 7))


def test_a_joint_at_rest_is_recognised_by_its_place_and_the_note_says_so(tmp_path):
    rest = Q * [1.0, 0.0] + 1e-5 * RNG.standard_normal(Q.shape)
    found = roles(tmp_path, TIME, rest, V * [1.0, 0.0], TORQUE, OTHER)
    assert found == expected(0, (1, 2), (3, 4), (5, 6))
    text = guess_layout(tmp_path / "log.csv", MOTORS)
    assert text.count("does not move, so only its place speaks for it") == 2


def test_a_log_may_begin_at_rest(tmp_path):
    still = np.zeros((7000, 2))
    time = TIME[0] + 0.01 * np.arange(8000)
    later = [np.vstack([still + part[0], part]) for part in (Q, V * [[0.0], *[[1.0]] * 999], TORQUE)]
    assert roles(tmp_path, time, *later, RNG.standard_normal(8000)) == expected(0, (1, 2), (3, 4), (5, 6))


def test_a_free_swing_of_as_many_columns_as_coordinates_and_actuators_has_a_time(tmp_path):
    one = Coordinates({"hip": "rad", "hip_velocity": "rad/s"}, ["motor"])
    found = roles(tmp_path, TIME, Q[:, 0], V[:, 0], model=one)
    assert found == {0: ("time", "time"), 1: ("hip", "observation"), 2: ("hip_velocity", "observation")}


def test_another_set_that_may_be_meant_is_spoken_of(tmp_path):
    noisy = 1e-4 * RNG.standard_normal(Q.shape)
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([TIME, Q, V, Q + noisy, V + noisy, TORQUE]), delimiter=",")
    assert "other columns may be too, such as commanded and measured ones" in guess_layout(path, MOTORS)


def test_the_command_of_a_servo_follows_its_position(tmp_path):
    servos = Coordinates(UNITS, ["hip_motor", "knee_motor"], servos="position")
    late = np.sin((TIME[:, None] + 0.05) * RATES)
    found = roles(tmp_path, TIME, Q, V, OTHER, late, model=servos)
    assert found == expected(0, (1, 2), (3, 4), (8, 9))


def test_a_motor_with_the_name_of_its_joint_has_another_one_in_the_log(tmp_path):
    alike = Coordinates(UNITS, ["hip", "knee"])
    for others in ([], [OTHER]):
        found = roles(tmp_path, TIME, Q, V, TORQUE, *others, model=alike)
        assert [found[5], found[6]] == [("hip_command", "action"), ("knee_command", "action")]
        assert found[1] == ("hip", "observation")


@pytest.mark.parametrize(("unit", "factor"), [("deg", 180.0 / np.pi), ("rad", 1.0)])
def test_degrees_are_recognised_as_well(tmp_path, unit, factor):
    assert roles(tmp_path, TIME, factor * Q, factor * V, TORQUE, OTHER) == expected(0, (1, 2), (3, 4), (5, 6))
    text = guess_layout(tmp_path / "log.csv", MOTORS)
    assert text.count(f'unit: "{unit}"') == text.count(f'unit: "{unit}/s"') == 2


def test_where_nothing_is_the_slope_of_another_column_only_the_time_is_named(tmp_path):
    found = roles(tmp_path, TIME, Q, TORQUE, OTHER)
    assert found == {0: ("time", "time")}
