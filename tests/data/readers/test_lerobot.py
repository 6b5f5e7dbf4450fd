"""LeRobot datasets of versions 2 and 3: columns, episodes, and the units of the positions."""

import json
import math

import numpy as np
import pytest

from tests.data.readers.guessing import renamed
from torchrl_h2o.data import DataError, load, sources_of
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

MOTORS = ("pan", "elbow_flex", "wrist_flex", "gripper")
JOINTS = ("Rotation", "Elbow", "Wrist")
ARM = Coordinates(
    dict.fromkeys(JOINTS, "rad") | {f"{name}_velocity": "rad/s" for name in JOINTS},
    ["wrist_servo", "pan_servo", "elbow_servo"],
    servos="position",
    driven={"wrist_servo": "Wrist", "pan_servo": "Rotation", "elbow_servo": "Elbow"},
)
ROWS = 40


def dataset(folder, version="v3.0", size=60.0):
    """Two episodes of 40 rows at 30 Hz, in one table or, in version 2, in one for each."""
    names = [f"{motor}.pos" for motor in MOTORS]
    described = {"dtype": "float32", "shape": [4], "names": names if version == "v3.0" else {"motors": names}}
    scalars = {name: {"dtype": "int64", "shape": [1], "names": None} for name in ("episode_index", "index")}
    image = {"dtype": "video", "shape": [480, 640, 3], "names": ["height", "width", "channels"]}
    features = {"action": described, "observation.state": described, "observation.images.top": image, **scalars}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    (folder / "meta").mkdir(parents=True)
    info = {"codebase_version": version, "fps": 30, "total_episodes": 2, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    time = np.arange(ROWS) / 30.0
    tables = []
    for episode in range(2):
        state = size * np.abs(np.sin(np.outer(time + episode, 1.0 + np.arange(4))))
        columns = {"action": list(state + 1.0), "observation.state": list(state), "timestamp": time}
        columns |= {"episode_index": np.full(ROWS, episode), "index": episode * ROWS + np.arange(ROWS)}
        tables.append(pyarrow.table(columns))
    tables = [pyarrow.concat_tables(tables)] if version == "v3.0" else tables
    for number, table in enumerate(tables):
        parquet.write_table(table, folder / "data" / "chunk-000" / f"episode_{number:06d}.parquet")
    return folder


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_guessed_layout_reads_the_dataset_of_an_arm_without_a_correction(tmp_path, version):
    """Two joints have a name of the dataset's; the others follow from the order, and the gripper has none."""
    folder = dataset(tmp_path / "arm", version)
    assert sources_of(folder) == (folder,)
    text = guess_layout(folder, ARM)
    (tmp_path / "arm.yaml").write_text(text)
    state = [f"observation.state.{motor}.pos" for motor in MOTORS[:3]]
    velocities = {f"{name}_velocity": f"{joint}_velocity" for name, joint in zip(state, JOINTS, strict=True)}
    assert renamed(text) == dict(zip(state, JOINTS, strict=True)) | velocities
    td = load(folder, columns=tmp_path / "arm.yaml")
    assert td["action"].shape == (len(td), 3)
    assert int(td["next", "done"].sum()) == 2
    first = td[0]
    assert is_close(first["action"].roll(-1) - first["observation"][:3], math.radians(1.0))


def is_close(values, expected):
    return bool((values - expected).abs().max() < 1e-5)


def entry(text, name):
    return next(line for line in text.splitlines() if f'name: "{name}"' in line)


def test_shares_of_a_servo_s_range_are_angles_by_its_calibration(tmp_path):
    folder = dataset(tmp_path / "arm")
    assert "or degrees? If it is a share, put the robot's calibration.json" in guess_layout(folder, ARM)
    ranges = {"pan": (1000, 3048, 0), "elbow_flex": (1000, 3048, 1), "gripper": (2048, 3072, 0)}
    described = {
        motor: {"id": 1, "drive_mode": mode, "homing_offset": 5, "range_min": low, "range_max": high}
        for motor, (low, high, mode) in ranges.items()
    }
    (folder / "calibration.json").write_text(json.dumps(described))
    text = guess_layout(folder, ARM)
    assert f'unit: "rad", scale: {math.pi / 200:.6g}, coordinate: "Rotation"' in entry(
        text, "observation.state.pan.pos"
    )
    assert f"scale: {-math.pi / 200:.6g}" in entry(text, "action.elbow_flex.pos")
    assert 'unit: "deg"' in entry(text, "action.wrist_flex.pos")


def test_shares_of_a_range_are_angles_by_the_range_of_the_joint_in_the_model(tmp_path):
    model = Coordinates(ARM.units, ARM.actuators, servos="position", driven=ARM.driven, ranges={"Elbow": (-1.0, 2.0)})
    text = guess_layout(dataset(tmp_path / "arm"), model)
    for name in ("observation.state.elbow_flex.pos", "action.elbow_flex.pos"):
        assert 'unit: "rad", scale: 0.015, offset: 0.5' in entry(text, name)
        assert "share of the range of Elbow in the model; check" in entry(text, name)


@pytest.mark.parametrize("motor", MOTORS[:3])
def test_one_unit_is_decided_for_all_positions(tmp_path, motor):
    """A joint that hardly moves is in the unit of the others, and so is its action."""
    model = Coordinates(ARM.units, ARM.actuators, servos="position", driven=ARM.driven, ranges={"Elbow": (-1.0, 2.0)})
    for size, unit in ((120.0, "deg"), (1.0, "rad")):
        text = guess_layout(dataset(tmp_path / unit, size=size), model)
        for name in (f"observation.state.{motor}.pos", f"action.{motor}.pos"):
            assert f'unit: "{unit}"' in entry(text, name)
            assert "scale" not in entry(text, name)


def test_a_dataset_without_its_tables_or_with_another_description_says_so(tmp_path):
    folder = dataset(tmp_path / "arm")
    layout = {
        "columns": [
            {"name": "action.pan.pos", "role": "action"},
            {"name": "observation.state[9]", "role": "observation"},
        ],
        "dt": 0.03,
        "header": True,
        "other_columns": "ignore",
    }
    with pytest.raises(DataError, match=r"column 'observation.state\[9\]': the column is missing.*elbow_flex.pos"):
        load(folder, columns=layout)
    with pytest.raises(DataError, match="give columns="):
        load(folder)
    (folder / "data" / "chunk-000" / "episode_000000.parquet").unlink()
    with pytest.raises(DataError, match=r"arm/data/\*/\*.parquet, are not there; download the data folder"):
        load(folder, columns=layout)
    (folder / "meta" / "info.json").write_text("{}")
    with pytest.raises(DataError, match="the tables of the LeRobot dataset"):
        load(folder, columns=layout)
