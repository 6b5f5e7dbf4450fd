"""Guessed columns of a body on a free joint, such as a drone's."""

import numpy as np
import pytest

from tests.data.readers.guessing import renamed
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates

FREE = ("root_x", "root_y", "root_z", "root_qw", "root_qx", "root_qy", "root_qz")
FREE_VELOCITIES = ("root_x", "root_y", "root_z", "root_roll", "root_pitch", "root_yaw")
DRONE = Coordinates(
    dict(zip(FREE, ["m"] * 3 + ["1"] * 4, strict=True))
    | {f"{name}_velocity": "m/s" if name[-1] in "xyz" else "rad/s" for name in FREE_VELOCITIES},
    ["thrust"],
)


@pytest.mark.parametrize(
    "names",
    [
        ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"),
        (
            *(f"pose.position.{axis}" for axis in "xyz"),
            *(f"pose.orientation.{axis}" for axis in "wxyz"),
            *(f"twist.linear.{axis}" for axis in "xyz"),
            *(f"twist.angular.{axis}" for axis in "xyz"),
        ),
        (
            *(f"pos_{axis}" for axis in "xyz"),
            *(f"quat_{axis}" for axis in "wxyz"),
            *(f"{axis}_dot" for axis in "xyz"),
            *(f"gyro_{axis}" for axis in "xyz"),
        ),
    ],
)
def test_columns_of_a_free_body_are_assigned_to_the_coordinates_of_a_free_joint(tmp_path, names):
    """Earlier, the quaternion and the velocities of a drone were columns to ignore."""
    time = 0.01 * np.arange(50)
    rows = np.zeros((50, 15))
    rows[:, 0], rows[:, 1], rows[:, 4], rows[:, 8], rows[:, 14] = (
        time,
        np.sin(time),
        1.0,
        np.cos(time),
        np.sin(9 * time),
    )
    header = ",".join(("t", *names, "thrust"))
    np.savetxt(tmp_path / "fly.csv", rows, delimiter=",", header=header, comments="")
    guessed = guess_layout(tmp_path / "fly.csv", DRONE)
    expected = dict(zip(names, DRONE.units, strict=True))
    assert renamed(guessed) == {name: other for name, other in expected.items() if name != other}
    assert guessed.count("role: observation") == 13
    assert "expected in the axes of the body, as a gyroscope measures it" in guessed


def test_of_a_free_body_without_velocities_the_translation_s_are_estimated(tmp_path):
    rows = np.zeros((50, 8))
    rows[:, 0], rows[:, 4] = 0.01 * np.arange(50), 1.0
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    np.savetxt(tmp_path / "fly.csv", rows, delimiter=",", header=",".join(("t", *names)), comments="")
    guessed = guess_layout(tmp_path / "fly.csv", DRONE)
    assert guessed.count("derivative_of") == 3
    assert renamed(guessed)["z_velocity"] == "root_z_velocity"


def test_four_numbers_that_are_no_unit_quaternion_are_not_assigned(tmp_path):
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    rows = np.column_stack([0.01 * np.arange(50), np.full((50, 7), 2.0)])
    np.savetxt(tmp_path / "fly.csv", rows, delimiter=",", header=",".join(("t", *names)), comments="")
    assert "root_qw" not in renamed(guess_layout(tmp_path / "fly.csv", DRONE)).values()


def drone_log(path, names, **moving):
    """A log of 4 s in which all columns but some are zero; the quaternions are 1, 0, 0, 0."""
    time = 0.01 * np.arange(400)
    rows = [time, *(np.ones(400) if name.endswith("qw") else np.zeros(400) for name in names)]
    for name, values in moving.items():
        rows[1 + names.index(name)] = values(time)
    np.savetxt(path, np.stack(rows, 1), delimiter=",", header=",".join(("t", *names)), comments="")
    return guess_layout(path, DRONE)


def test_neither_commands_nor_targets_nor_accelerations_are_the_state_of_a_free_body(tmp_path):
    state = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "imu.angular.x", "imu.angular.y", "imu.angular.z")
    others = ("cmd_vx", "cmd_vy", "cmd_vz", "target_qw", "target_qx", "target_qy", "target_qz", "gyro_bias_x")
    accelerations = tuple(f"imu.linear_acceleration.{axis}" for axis in "xyz")
    guessed = drone_log(tmp_path / "fly.csv", (*others, *accelerations, *state))
    assert renamed(guessed) == dict(zip(state, DRONE.units, strict=True))


def test_units_in_the_names_of_a_free_body_s_columns_are_kept(tmp_path):
    names = ("x [mm]", "y [mm]", "z [mm]", "qw", "qx", "qy", "qz", "gyro_x (deg/s)", "gyro_y (deg/s)", "gyro_z (deg/s)")
    guessed = drone_log(tmp_path / "fly.csv", names)
    assert renamed(guessed)["gyro_x (deg/s)"] == "root_roll_velocity"
    assert guessed.count('unit: "deg/s"') == 3
    assert guessed.count('unit: "mm"') == 3


def test_velocities_of_odometry_are_estimated_all_three(tmp_path):
    """Earlier, the command that --guess prints named a column that it had left out."""
    names = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
    guessed = drone_log(tmp_path / "fly.csv", names, x=np.sin, vx=lambda t: np.sin(3.0 * t), y=np.sin, vy=np.cos)
    assert {name for name, other in renamed(guessed).items() if other.endswith("_velocity")} == {
        f"{axis}_velocity" for axis in "xyz"
    }
    assert guessed.count("perhaps in the axes of the body") == 3


def test_velocities_of_a_body_whose_place_is_not_logged_are_not_those_of_other_joints(tmp_path):
    guessed = drone_log(tmp_path / "walk.csv", ("qw", "qx", "qy", "qz", "vx", "vy", "vz", "hip", "knee", "ankle"))
    assert renamed(guessed)["vx"] == "root_x_velocity"
