"""Euler angles of a free body: read as a quaternion, guessed, and refused where one is missing."""

import mujoco
import numpy as np
import pytest
import yaml

from tests.data.readers.guessing import renamed
from torchrl_h2o.data import DataError, LogColumns, load
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates

FREE = ("root_x", "root_y", "root_z", "root_qw", "root_qx", "root_qy", "root_qz")
DRONE = Coordinates(
    dict(zip(FREE, ["m"] * 3 + ["1"] * 4, strict=True))
    | {
        f"root_{name}_velocity": "m/s" if name in "xyz" else "rad/s" for name in ("x", "y", "z", "roll", "pitch", "yaw")
    },
    ["thrust"],
)
ANGLES = np.deg2rad([[20.0, -35.0, 50.0], [25.0, -30.0, 179.0], [30.0, -25.0, -179.0], [35.0, -20.0, -170.0]])


def columns(**changed):
    described = [
        {"name": f"att_{name}", "role": "euler", "unit": "deg", "coordinate": f"root_{name}"}
        for name in ("yaw", "roll", "pitch")
    ]
    described[0] |= changed
    return {
        "columns": [*described, {"name": "thrust", "role": "action"}],
        "dt": 0.01,
        "separator": ",",
        "header": True,
    }


def log(folder):
    path = folder / "fly.csv"
    rows = np.column_stack([np.rad2deg(ANGLES[:, [2, 0, 1]]), np.ones(4)])
    np.savetxt(path, rows, delimiter=",", header="att_yaw,att_roll,att_pitch,thrust", comments="")
    return path


def test_euler_angles_become_the_quaternion_that_mujoco_makes_of_them(tmp_path):
    layout = LogColumns.load(columns())
    assert layout.observation == ("root_qw", "root_qx", "root_qy", "root_qz")
    td = load(log(tmp_path), columns=layout)
    for (roll, pitch, yaw), found in zip(ANGLES, td["observation"].numpy(), strict=False):
        expected = np.empty(4)
        mujoco.mju_euler2Quat(expected, np.array([yaw, pitch, roll]), "zyx")
        assert abs(found @ expected) == pytest.approx(1.0, abs=1e-6)


def test_the_euler_angles_of_a_free_body_are_guessed(tmp_path):
    time = 0.01 * np.arange(50)
    names = ("x", "y", "z", "imu_roll", "imu_pitch", "imu_yaw", "thrust")
    moving = [np.sin((1.0 + i) * time) for i in range(len(names))]
    header = ",".join(("t", *names))
    np.savetxt(tmp_path / "fly.csv", np.stack([time, *moving], 1), delimiter=",", header=header, comments="")
    text = guess_layout(tmp_path / "fly.csv", DRONE)
    assert '"imu_yaw", role: euler, unit: "rad", coordinate: "root_yaw"}' in text
    assert "# root_yaw of the model; turns about z, then y, then x" in text
    layout = LogColumns.load(yaml.safe_load(text))
    assert set(FREE) <= set(layout.coordinates.values())
    assert renamed(text)["x"] == "root_x"
    assert load(tmp_path / "fly.csv", columns=layout)["observation"].shape[1] == 10


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"role": "ignore", "coordinate": None}, "three columns have the role euler, one for each of roll, pitch, yaw"),
        ({"coordinate": "root_pitch"}, "three columns have the role euler"),
        ({"coordinate": "body_yaw"}, "three columns have the role euler"),
        ({"coordinate": "root"}, "an Euler angle needs its unit, rad or deg, and coordinate"),
        ({"unit": "m"}, "an Euler angle needs its unit"),
    ],
)
def test_what_is_no_set_of_euler_angles_is_refused(changed, said):
    with pytest.raises(DataError, match=said):
        LogColumns.load(columns(**changed))
