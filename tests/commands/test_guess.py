"""close-the-loop --guess: a first layout that can be read, and what it says to check."""

import sys

import numpy as np
import pytest

from torchrl_h2o.commands.close_the_loop import run
from torchrl_h2o.commands.guess import guess_columns
from torchrl_h2o.data import DataError, LogColumns, load

MODEL = """
<mujoco>
  <worldbody>
    <body><joint name="slider" type="slide" axis="1 0 0"/><geom size="0.1"/>
      <body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0 0 -0.5"/></body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
</mujoco>
"""
T = 0.004 * np.arange(300)
COLUMNS = {"t_ms": 1e3 * T, "slider_pos": np.sin(T), "hip.angle [deg]": 57.3 * np.cos(T), "hip.rate": -57.3 * np.sin(T)}
COLUMNS |= {"tau_cmd": np.sin(9 * T), "phase": T}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.xml").write_text(MODEL)
    np.savetxt("log.csv", np.stack(list(COLUMNS.values()), 1), delimiter=",", header=",".join(COLUMNS), comments="")
    return tmp_path


def test_a_first_layout_is_written_and_can_be_read(folder, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["close-the-loop", "--guess", "data=log.csv", "simulator=robot.xml"])
    run()
    printed = capsys.readouterr().out
    assert "log.yaml describes the columns of log.csv; correct it, then run" in printed
    assert "close-the-loop simulator=robot.xml data=log.csv columns=log.yaml" in printed
    layout = LogColumns.load("log.yaml")
    assert layout.coordinates == {
        "slider_pos": "slider",
        "hip.angle [deg]": "hip",
        "hip.rate": "hip_velocity",
        "slider_pos_velocity": "slider_velocity",
    }
    assert {column.name: (column.role, column.unit) for column in layout.columns} == {
        "t_ms": ("time", "ms"),
        "slider_pos": ("observation", "m"),
        "hip.angle [deg]": ("observation", "deg"),
        "hip.rate": ("observation", "rad/s"),
        "tau_cmd": ("action", "N"),
        "phase": ("ignore", "1"),
        "slider_pos_velocity": ("observation", "1"),
    }
    assert layout.derivatives == {"slider_pos_velocity": "slider_pos"}
    td = load("log.csv", columns=layout)
    assert td["observation"].shape[1] == 4
    text = (folder / "log.yaml").read_text()
    assert 'coordinate: "hip_velocity"}  # slope of hip.angle [deg]: 1 times this' in text
    assert "# not recognised: observation, action or ignore?" in text
    assert "the median step is 4, which is 0.004 s, 250 Hz" in text


def test_desired_positions_are_the_actions_of_servos(folder):
    (folder / "servo.xml").write_text(MODEL.replace("<motor", '<position kp="30"'))
    columns = {"t": T, "slider_pos": np.sin(T), "hip_pos": np.cos(T), "hip_tau": T, "slider_pos_des": np.sin(T)}
    np.savetxt("servo.csv", np.stack(list(columns.values()), 1), delimiter=",", header=",".join(columns), comments="")
    guess_columns(["--guess", "data=servo.csv", "simulator=servo.xml"])
    assert LogColumns.load("servo.yaml").action == ("slider_pos_des",)
    guess_columns(["--guess", "data=servo.csv", "simulator=robot.xml", "columns=motor.yaml"])
    assert LogColumns.load("motor.yaml").action == ("hip_tau",)


def test_a_file_is_never_overwritten(folder):
    guess_columns(["--guess", "data=log.csv", "columns=mine.yaml"])
    (folder / "mine.yaml").write_text("corrected")
    with pytest.raises(DataError, match=r"mine\.yaml: the file exists and is not overwritten; remove it"):
        guess_columns(["--guess", "data=log.csv", "columns=mine.yaml"])
    assert (folder / "mine.yaml").read_text() == "corrected"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the log is missing; write close-the-loop --guess data=log.csv"),
        (["data=log.csv", "held_out=0.2"], "held_out is not an option of --guess"),
        (["data=none.csv"], "none.csv: there is no such file"),
        (["data=log.csv", "simulator=none.xml"], "simulator=none.xml: there is no file none.xml"),
        (["data=robot.xml"], "no (column|two rows) of numbers"),
    ],
)
def test_wrong_arguments_are_named(folder, arguments, message):
    with pytest.raises(ValueError, match=message):
        guess_columns(["--guess", *arguments])
    assert not list(folder.glob("*.yaml"))


def test_an_error_is_one_line(folder, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["close-the-loop", "--guess", "data=none.csv"])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit):
        run()
    assert capsys.readouterr().err == "DataError: none.csv: there is no such file; check the path\n"


def test_a_log_without_names_takes_the_model_s_order(folder):
    rows = np.stack([T, np.sin(T), np.cos(T), np.cos(T), -np.sin(T), T], 1)
    np.savetxt("log.txt", rows)
    guess_columns(["--guess", "data=log.txt", "simulator=robot.xml"])
    layout = LogColumns.load("log.yaml")
    assert layout.observation == ("slider", "hip", "slider_velocity", "hip_velocity")
    assert layout.action == ("push",)
    assert len(load("log.txt", columns=layout)) == 299


def test_a_layout_that_cannot_be_read_yet_is_written_and_says_why(folder, capsys):
    np.savetxt("log.txt", np.ones((5, 3)))
    guess_columns(["--guess", "data=log.txt"])
    assert "Not yet readable: log.yaml: there is no column with the role 'observation'" in capsys.readouterr().out
    assert "dt: 0.01  # no column of time was found" in (folder / "log.yaml").read_text()


def test_names_in_a_comment_and_decimal_commas_are_found(folder):
    np.savetxt("log.dat", np.stack([T, np.sin(T), np.cos(T), T], 1), header="time theta theta_dot u")
    guess_columns(["--guess", "data=log.dat", "columns=dat.yaml"])
    assert LogColumns.load("dat.yaml").observation == ("theta", "theta_dot")
    assert len(load("log.dat", columns="dat.yaml")) == 299
    rows = "\n".join(f"{t:.4f};{np.sin(t):.4f};0,5".replace(".", ",") for t in T)
    (folder / "de.csv").write_text(f"Zeit_ms;theta;u\n{rows}\n")
    guess_columns(["--guess", "data=de.csv"])
    layout = LogColumns.load("de.yaml")
    assert (layout.separator, layout.decimal) == (";", ",")


@pytest.mark.parametrize("name", ["log.npz", "log.parquet", "log.mat"])
def test_other_formats_are_guessed_too(folder, name):
    columns = {"time": T, "q": np.stack([np.sin(T), np.cos(T)], 1), "qd": np.stack([np.cos(T), -np.sin(T)], 1), "u": T}
    flat = {"time": T, "q0": np.sin(T), "q1": np.cos(T), "qd0": np.cos(T), "qd1": -np.sin(T), "u": T}
    if name == "log.npz":
        np.savez(name, **columns)
    elif name == "log.mat":
        from scipy.io import savemat

        savemat(name, columns)
    else:
        pyarrow = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(pyarrow.table(flat), name)
    guess_columns(["--guess", f"data={name}"])
    td = load(name, columns="log.yaml")
    assert (td["observation"].shape, td["action"].shape) == ((299, 4), (299, 1))
    assert not LogColumns.load("log.yaml").derivatives


@pytest.mark.parametrize(
    ("motor", "unit"),
    [('site="hub" gear="0 0 1 0 0 0.02"', "N"), ('site="hub" gear="0 0 0 0 0 1"', "N·m"), ('joint="hip"', "N·m")],
)
def test_the_unit_of_actions_is_that_of_what_the_actuators_exert(folder, motor, unit):
    """Earlier, the thrusts of a quadrotor were N·m."""
    body = '<body><joint name="hip"/><geom size="0.1"/><site name="hub"/></body>'
    actuator = f"<actuator><motor {motor}/></actuator>"
    (folder / "robot.xml").write_text(f"<mujoco><worldbody>{body}</worldbody>{actuator}</mujoco>")
    guess_columns(["--guess", "data=log.csv", "simulator=robot.xml"])
    assert {column.unit for column in LogColumns.load("log.yaml").columns if column.role == "action"} == {unit}


def test_a_place_that_cannot_be_written_is_named(folder):
    (folder / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"file/log\.yaml: the file cannot be written: .*; choose another name"):
        guess_columns(["--guess", "data=log.csv", "columns=file/log.yaml"])


def test_columns_of_one_run_in_several_files_are_not_described_by_the_first(folder):
    for name in ("position", "effort"):
        np.savetxt(f"{name}.csv", np.stack([T, T], 1), delimiter=",", header=f"t,hip_{name}", comments="")
    with pytest.raises(DataError, match="one run in 2 files; give 'data="):
        guess_columns(["--guess", "data=[position.csv, effort.csv]"])


def test_actions_with_the_names_of_actuators_are_in_the_model_s_order(folder, capsys):
    servos = "".join(f'<position name="{name}" joint="{name}" kp="9"/>' for name in ("slider", "hip"))
    (folder / "servo.xml").write_text(MODEL.replace('<motor name="push" joint="slider"/>', servos))
    columns = {"t": T, "slider": np.sin(T), "hip": np.cos(T), "hip_des": np.cos(T), "slider_des": np.sin(T)}
    np.savetxt("log.csv", np.stack(list(columns.values()), 1), delimiter=",", header=",".join(columns), comments="")
    guess_columns(["--guess", "data=log.csv", "simulator=servo.xml"])
    assert LogColumns.load("log.yaml").action == ("slider_des", "hip_des")
    assert "Not yet readable" not in capsys.readouterr().out
