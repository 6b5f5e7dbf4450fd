"""Several logs in one recording: their order, rows, and which are held out."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.composed import COMMANDS, composed
from torchrl_h2o.commands.close_the_loop import make_simulation
from torchrl_h2o.commands.recording import Recording, read_recording, split_by_name
from torchrl_h2o.data import write_ted
from torchrl_h2o.data.readers.observed import words_of_estimates
from torchrl_h2o.data.readers.quaternion_signs import continuous_quaternions
from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.state_map import coordinate_names

LAYOUT = """
dt: 0.01
separator: ","
header: true
columns:
  - {name: pivot, role: observation, unit: rad}
  - {name: pivot_velocity, role: observation, unit: rad/s}
  - {name: torque, role: action, unit: N·m}
"""
MODEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody><body><joint name="pivot" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.5"/></body></worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>
"""


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """Logs a, b and c of 10, 20 and 30 rows in a folder, each with values of its own."""
    (tmp_path / "logs").mkdir()
    for start, name, rows in ((0, "a", 10), (1000, "b", 20), (2000, "c", 30)):
        values = start + np.arange(3.0 * rows).reshape(rows, 3)
        path = tmp_path / "logs" / f"{name}.csv"
        np.savetxt(path, values, delimiter=",", header="pivot,pivot_velocity,torque", comments="")
    (tmp_path / "log.yaml").write_text(LAYOUT)
    (tmp_path / "robot.xml").write_text(MODEL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read(*overrides):
    mjcf = ["simulator=mjcf", "simulator.path=robot.xml", "columns=log.yaml"]
    cfg = composed("close_the_loop", *mjcf, *overrides, folder=COMMANDS)
    recording = read_recording(cfg)
    return recording, make_simulation(cfg, recording)


@pytest.mark.parametrize(
    "data", ["[logs/a.csv,logs/b.csv,logs/c.csv]", "logs/*.csv", "logs", "['logs/[ab].csv',logs/c.csv]"]
)
def test_a_list_a_glob_and_a_folder_are_runs_of_their_own(logs, data):
    recording, simulation = read(f"data={data}", "held_out=0.25")
    assert recording.logs == ("a.csv", "b.csv", "c.csv")
    assert recording.transitions["log"].dtype == torch.int64
    assert recording.transitions["log"].bincount().tolist() == [9, 19, 29]
    assert recording.transitions["next", "done"].flatten().nonzero().flatten().tolist() == [8, 27, 56]
    measured = Measured.from_ted(recording.transitions, simulation)
    assert [rows.stop - rows.start for rows in measured.runs] == [9, 19, 29]
    assert recording.reported_on == 0.25


@pytest.mark.parametrize(
    ("data", "held_out"),
    [
        ("logs", "[a.csv]"),
        ("logs", "a.csv"),
        ("logs/*.csv", "[logs/a.csv]"),
        ("logs", "'a*'"),
        ("[logs/b.csv,logs/c.csv]", "[logs/a.csv]"),
        ("[logs/b.csv,logs/c.csv]", "'logs/a*'"),
    ],
)
def test_logs_held_out_by_name_come_last(logs, data, held_out):
    recording, simulation = read(f"data={data}", f"held_out={held_out}")
    assert recording.logs == ("b.csv", "c.csv", "a.csv")
    assert recording.held_out == ("a.csv",)
    assert recording.source.endswith("all 57 rows; held out: a.csv")
    measured = Measured.from_ted(recording.transitions, simulation, held_out=recording.reported_on)
    assert measured.observation[measured.held_out].max() < 1000 <= measured.observation[~measured.held_out].min()


def test_logs_of_the_same_name_are_told_apart(logs):
    (logs / "other").mkdir()
    (logs / "logs" / "a.csv").rename(logs / "other" / "b.csv")
    recording, _ = read("data=[logs/b.csv,other/b.csv]", "held_out=[other/b.csv]")
    assert recording.logs == ("logs/b.csv", "other/b.csv")
    assert recording.held_out == ("other/b.csv",)


def test_rows_are_selected_of_each_log(logs):
    recording, _ = read("data=logs", "first_row=5", "transitions=6")
    assert recording.transitions["log"].bincount().tolist() == [4, 6, 6]
    assert recording.transitions["next", "truncated"].flatten().nonzero().flatten().tolist() == [3, 9, 15]
    assert recording.source == "logs, 16 of 57 rows, from row 5 of each"
    with pytest.raises(ValueError, match=r"first_row=9 .* select none of the 9 rows of a.csv"):
        read("data=logs", "first_row=9")


def test_a_single_log_and_a_data_set_have_one_log(logs):
    recording, _ = read("data=logs/c.csv")
    assert recording.logs == ("c.csv",)
    assert recording.transitions["log"].unique().tolist() == [0]
    ends = np.zeros(20, bool)
    values = np.arange(21.0)[:, None].repeat(2, 1)
    td = to_ted(
        observation=values[:-1], action=values[:-1, :1], next_observation=values[1:], terminated=ends, truncated=ends
    )
    write_ted(td, logs / "ted")
    recording, _ = read(
        "data=ted", "columns=null", "simulator.coordinates=[pivot,pivot_velocity]", "simulator.control_step=0.01"
    )
    assert recording.logs == ("ted",)
    assert recording.transitions["log"].unique().tolist() == [0]


@pytest.mark.parametrize(
    ("data", "held_out", "message"),
    [
        ("logs", "[z.csv]", "held_out=z.csv: there is no such file, and the data are a.csv, b.csv, c.csv"),
        ("logs", "[a.csv,b.csv,c.csv]", "leaves no log for the fit"),
        ("logs", "'z*'", "no file has such a name"),
        ("logs/d*.csv", "0.3", "no file has such a name"),
        ("[]", "0.3", "the list of data is empty"),
    ],
)
def test_logs_that_are_not_there_are_named(logs, data, held_out, message):
    with pytest.raises(ValueError, match=message):
        read(f"data={data}", f"held_out={held_out}")


def test_a_recording_of_one_run_cannot_be_split_by_name():
    cfg = composed("close_the_loop", "held_out=[c.csv]", folder=COMMANDS)
    with pytest.raises(ValueError, match="data=recorded is one run; give a share"):
        read_recording(cfg)


def test_each_file_is_taken_once(logs):
    sources, held_out = split_by_name(["logs", "logs/a.csv"], ["logs/c.csv", "c.csv"])
    assert [str(one) for one in sources] == ["logs/a.csv", "logs/b.csv", "logs/c.csv"]
    assert held_out == ("c.csv",)


def test_a_free_motion_has_the_model_s_actuators_at_zero(logs):
    text = LAYOUT.replace("header: true", "header: true\nother_columns: ignore\nfree_motion: true")
    (logs / "log.yaml").write_text("\n".join(line for line in text.splitlines() if "torque" not in line))
    recording, simulation = read("data=logs")
    assert recording.transitions["action"].shape == (57, 0)
    free = recording.for_simulation(simulation)
    assert free.transitions["action"].shape == (57, 1)
    assert not free.transitions["action"].any()
    assert recording.transitions["action"].shape == (57, 0)
    Measured.from_ted(free.transitions, simulation)
    assert read("data=logs")[0].for_simulation(simulation).logs == recording.logs


def test_an_estimated_velocity_is_part_of_the_recording(logs):
    text = LAYOUT.replace(
        "{name: pivot_velocity, role: observation, unit: rad/s}", "{name: pivot_velocity, role: ignore}"
    )
    text += "  - {name: rate, role: observation, derivative_of: pivot}\n"
    (logs / "log.yaml").write_text(text)
    recording, _ = read("data=logs", "simulator.coordinates={rate: pivot_velocity}")
    (estimate,) = recording.estimated
    assert (estimate.name, estimate.position, estimate.unit) == ("rate", "pivot", "rad/s")
    words = words_of_estimates([estimate, replace(estimate, name="other")])
    assert words.startswith("not measured but estimated: rate from pivot, with an error of ")
    assert words.count("other from pivot") == words.count("smooth over time") == 1
    torch.testing.assert_close(recording.transitions["observation"][:, 1], torch.full((39,), 300.0), rtol=1e-3, atol=0)


def test_quaternions_of_a_tracker_get_a_continuous_sign(tmp_path):
    body = "<body><freejoint name='root'/><geom size='0.1'/></body>"
    (tmp_path / "body.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    names, units = coordinate_names(mujoco.MjModel.from_xml_path(str(tmp_path / "body.xml")))
    state_map = StateMap.of_coordinates(tuple(names), tuple(units), range(13), num_states=13)
    simulation = Simulation(lambda: mujoco.MjSpec.from_file(str(tmp_path / "body.xml")), 1, state_map)
    rows = np.random.default_rng(0).standard_normal((6, 13))
    rows[:, 3:7] = np.array([1.0, 0.2, 0.0, 0.0]) * np.array([1, -1, -1, 1, 1, -1])[:, None]
    none = np.zeros(5, bool)
    td = to_ted(
        observation=rows[:-1], action=np.zeros((5, 0)), next_observation=rows[1:], terminated=none, truncated=none
    )
    made = Recording(td, "rows").for_simulation(simulation).transitions
    assert (made["observation"][:, 3] == 1.0).all()
    assert (made["next", "observation"][:, 3] == 1.0).all()
    assert (made["observation"][:, 7:] == td["observation"][:, 7:]).all()
    assert (td["observation"][:, 3] != 1.0).any()


def test_a_tracker_that_loses_the_body_for_a_row_does_not_lose_the_sign():
    rows = torch.tensor([1.0, 1.0, 0.0, -1.0, -1.0])[:, None] * torch.tensor([1.0, 0.0, 0.0, 0.0])
    td = TensorDict({"observation": rows[:-1], "next": {"observation": rows[1:]}}, [4])
    assert continuous_quaternions(td, range(4))["observation"][:, 0].tolist() == [1.0, 1.0, 0.0, 1.0]
