"""A run in several files of columns: joined on time, guessed, and told from several runs."""

import numpy as np
import pytest
import yaml

from torchrl_h2o.data import DataError, LogColumns, load, sources_of
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates

COLUMNS = {
    "columns": [
        {"name": "position.t", "role": "time", "unit": "s"},
        {"name": "position.hip", "role": "observation", "unit": "rad"},
        {"name": "effort.hip", "role": "action", "unit": "N·m"},
    ],
    "separator": ",",
    "header": True,
    "other_columns": "ignore",
}


def write(folder, name, time, values, column="hip"):
    path = folder / f"{name}.csv"
    np.savetxt(path, np.stack([time, values], 1), delimiter=",", header=f"t,{column}", comments="", fmt="%.9g")
    return path


def run_of(folder, effort_times, rows=50, column="hip"):
    """Positions every 10 ms, equal to the time, and efforts equal to their own time."""
    time = 0.01 * np.arange(rows)
    return {
        "position": write(folder, "position", time, time, column),
        "effort": write(folder, "effort", effort_times, effort_times, column),
    }


def test_rows_of_two_files_are_joined_with_the_nearest(tmp_path):
    """The clocks of two topics differ by some of a step, to either side."""
    for shift in (0.004, -0.004):
        td = load(run_of(tmp_path, 0.01 * np.arange(60) - 0.05 + shift), columns=COLUMNS)
        late = td["action"][:, 0] - td["observation"][:, 0]
        assert late.numpy() == pytest.approx(np.full(len(td), shift), abs=1e-6)
        assert len(td) == 49


def test_slower_commands_hold_until_the_next(tmp_path):
    """A command of 20 Hz does not act before it was sent, and rows before the first one are left out."""
    sent = 0.02 + 0.05 * np.arange(12)
    td = load(run_of(tmp_path, sent), columns=COLUMNS)
    time, command = td["observation"][:, 0].numpy(), td["action"][:, 0].numpy()
    assert time[0] == pytest.approx(0.02)
    expected = [sent[sent <= moment + 1e-6].max() for moment in time]
    assert command == pytest.approx(np.array(expected), abs=1e-6)


def test_faster_commands_are_those_at_the_row(tmp_path):
    td = load(run_of(tmp_path, 0.001 * np.arange(600)), columns=COLUMNS)
    assert td["action"].numpy() == pytest.approx(td["observation"].numpy(), abs=1e-6)


def test_rows_where_another_file_has_a_gap_are_left_out(tmp_path):
    sent = 0.01 * np.concatenate([np.arange(20), np.arange(30, 50)])
    td = load(run_of(tmp_path, sent), columns={**COLUMNS, "on_time_jump": "split"})
    assert (td["action"] - td["observation"]).abs().max() < 0.021
    assert int(td["next", "done"].sum()) == 2


def test_runs_that_share_a_file_are_different_runs(tmp_path):
    files = run_of(tmp_path, 0.01 * np.arange(50))
    (tmp_path / "other.csv").write_text(files["effort"].read_text())
    assert len(sources_of([files, {**files, "effort": tmp_path / "other.csv"}])) == 2
    with pytest.raises(DataError, match=r"nowhere\.csv: there is no such file"):
        sources_of({**files, "effort": tmp_path / "nowhere.csv"})


def test_the_guessed_layout_reads_the_run(tmp_path):
    files = run_of(tmp_path, 0.01 * np.arange(50))
    write(tmp_path, "velocity", 0.01 * np.arange(50), np.ones(50))
    files["velocity"] = tmp_path / "velocity.csv"
    (log,) = sources_of({name: files[name] for name in ("position", "velocity", "effort")})
    model = Coordinates({"hip": "rad", "hip_velocity": "rad/s"}, ["motor"])
    layout = LogColumns.load(yaml.safe_load(guess_layout(log, model)))
    assert layout.coordinates == {"position.hip": "hip", "velocity.hip": "hip_velocity"}
    assert layout.action == ("effort.hip",)
    td = load({name: str(path) for name, path in files.items()}, columns=layout)
    assert td["observation"][:, 1].tolist() == [1.0] * 49


def test_runs_of_several_files_are_runs(tmp_path):
    parts = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        parts.append(run_of(tmp_path / name, 0.01 * np.arange(50)))
    td = load(parts, columns=COLUMNS)
    assert td["log"].unique().tolist() == [0, 1]


@pytest.mark.parametrize(
    ("effort_times", "said"),
    [
        (
            7.0 + 0.01 * np.arange(50),
            "share less than half of their time: position from 0 to 0.49; effort from 7 to 7.49",
        ),
        (10.0 * np.arange(50), r"effort from 0 to 490; give files of one run whose times have the same unit"),
        (0.01 * np.arange(50)[::-1], r"effort.csv: the time goes back"),
        (np.where(np.arange(50) == 20, np.nan, 0.01 * np.arange(50)), r"effort.csv: the time goes back or is missing"),
    ],
)
def test_files_that_cannot_be_joined_say_why(tmp_path, effort_times, said):
    with pytest.raises(DataError, match=said):
        load(run_of(tmp_path, effort_times), columns=COLUMNS)


def test_files_without_a_common_clock_say_what_is_needed(tmp_path):
    files = run_of(tmp_path, 0.01 * np.arange(50))
    without = {**COLUMNS, "dt": 0.01, "columns": COLUMNS["columns"][1:]}
    with pytest.raises(DataError, match="joined on time, and no column position"):
        load(files, columns=without)
    with pytest.raises(DataError, match=r"does not name the files of one run.*position: a\.csv, effort: b\.csv"):
        load({"position": files["position"]}, columns=COLUMNS)
    (tmp_path / "effort.csv").write_text("stamp,hip\n0,1\n0.01,1\n")
    with pytest.raises(DataError, match=r"effort\.csv, column 't'.*the column is missing"):
        load(files, columns=COLUMNS)
    with pytest.raises(DataError, match="the columns of time are called t, stamp; give them the same name"):
        guess_layout(sources_of(files)[0])


def test_files_of_columns_of_one_run_are_not_taken_for_runs(tmp_path):
    columns = [("t", "time", "s"), ("hip", "observation", "rad"), ("effort", "action", "N·m")]
    described = {"columns": [dict(zip(("name", "role", "unit"), one, strict=True)) for one in columns]}
    described |= {"separator": ",", "header": True}
    time = 0.01 * np.arange(50)
    for begin, said in (
        (0.003, r"one run in 2 files; give 'data={hip: .*hip.csv, effort: .*effort.csv}'"),
        (7.0, "missing"),
    ):
        files = [write(tmp_path, "hip", time, time), write(tmp_path, "effort", time + begin, time, "effort")]
        with pytest.raises(DataError, match=said):
            load(files, columns=described)
    (tmp_path / "broken.csv").write_text("nothing")
    with pytest.raises(DataError, match="the column is missing") as caught:
        load([*files, tmp_path / "broken.csv"], columns=described)
    assert caught.value.source.endswith("hip.csv")
