"""Columns without names, of which there are more than the model has coordinates and actuators."""

import re

import numpy as np
import pytest

from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates

UNITS = {"hip": "rad", "knee": "rad", "hip_velocity": "rad/s", "knee_velocity": "rad/s"}
MOTORS = Coordinates(UNITS, ["hip_motor", "knee_motor"])
RNG = np.random.default_rng(0)
TIME = 12.0 + 0.01 * np.arange(2000)
RATES = np.array([1.3, 2.1])
Q = np.sin(TIME[:, None] * RATES)
V = RATES * np.cos(TIME[:, None] * RATES)
TORQUE = 3.0 * np.sin(TIME[:, None] * [0.7, 3.9])
OTHER = RNG.standard_normal((2000, 3))
ZERO = np.zeros((2000, 2))


def roles(tmp_path, *columns, model=MOTORS) -> dict[int, tuple[str, str]]:
    """Name and role of each column that is not ignored, by its index."""
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack(columns), delimiter=",")
    found = re.findall(r'name: "(\w+)", role: (\w+)', guess_layout(path, model).text)
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
    """The accelerations are the slopes of the velocities, but positions come first."""
    found = roles(tmp_path, TIME, TORQUE, Q, V, ZERO, Q + 1e-3 * OTHER[:, :2])
    assert found == expected(0, (3, 4), (5, 6), (1, 2))
    accelerations = -(RATES**2) * Q
    assert roles(tmp_path, TIME, Q, V, accelerations, OTHER[:, :1]) == expected(0, (1, 2), (3, 4), (5, 6))


def test_another_set_that_may_be_meant_is_spoken_of(tmp_path):
    noisy = 1e-4 * RNG.standard_normal(Q.shape)
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([TIME, Q, V, Q + noisy, V + noisy, TORQUE]), delimiter=",")
    assert "other columns may be too, such as commanded and measured ones" in guess_layout(path, MOTORS).text


def test_the_command_of_a_servo_follows_its_position(tmp_path):
    servos = Coordinates(UNITS, ["hip_motor", "knee_motor"], servos=True)
    late = np.sin((TIME[:, None] + 0.05) * RATES)
    found = roles(tmp_path, TIME, Q, V, OTHER, late, model=servos)
    assert found == expected(0, (1, 2), (3, 4), (8, 9))


def test_a_motor_with_the_name_of_its_joint_has_another_one_in_the_log(tmp_path):
    alike = Coordinates(UNITS, ["hip", "knee"])
    for others in ([], [OTHER]):
        found = roles(tmp_path, TIME, Q, V, TORQUE, *others, model=alike)
        assert [found[5], found[6]] == [("hip_command", "action"), ("knee_command", "action")]
        assert found[1] == ("hip", "observation")


@pytest.mark.parametrize("factor", [180.0 / np.pi, 1.0])
def test_degrees_are_recognised_as_well(tmp_path, factor):
    assert roles(tmp_path, TIME, factor * Q, factor * V, TORQUE, OTHER) == expected(0, (1, 2), (3, 4), (5, 6))


def test_where_nothing_is_the_slope_of_another_column_only_the_time_is_named(tmp_path):
    found = roles(tmp_path, TIME, Q, TORQUE, OTHER)
    assert found == {0: ("time", "time")}
