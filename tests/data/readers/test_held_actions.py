"""Logs whose targets have another rate than their readings: a target holds until the next one."""

import numpy as np
import pytest
import yaml

from torchrl_h2o.data import DataError, LogColumns, episodes, load
from torchrl_h2o.data.readers.guess import guess_layout

NAMES = ("t", "hip", "knee", "target")
COLUMNS = {
    "columns": [
        {"name": "t", "role": "time", "unit": "s"},
        {"name": "hip", "role": "observation", "unit": "rad"},
        {"name": "knee", "role": "observation", "unit": "rad"},
        {"name": "target", "role": "action", "unit": "deg"},
    ],
    "separator": ",",
    "header": True,
}


def write(tmp_path, rows, names=NAMES):
    """Writes rows of numbers and None, for an empty cell."""
    lines = [",".join("" if cell is None else f"{cell:.6g}" for cell in row) for row in rows]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(names), *lines]) + "\n")
    return path


def slower_targets(rows=100, every=10, first=0):
    """Readings at 500 Hz, and targets, equal to their row, at 50 Hz."""
    return [(0.002 * i, 0.1, np.sin(0.01 * i), i if i % every == 0 and i >= first else None) for i in range(rows)]


def test_a_slower_target_holds_until_the_next(tmp_path, log_messages):
    td = load(write(tmp_path, slower_targets()), columns=COLUMNS)
    expected = np.deg2rad(10.0 * (np.arange(99) // 10))
    assert td["action"][:, 0].numpy() == pytest.approx(expected, abs=1e-6)
    assert "of 100 rows, 90 hold the last value of an action" in log_messages[0]


def test_rows_before_the_first_target_are_left_out(tmp_path, log_messages):
    td = load(write(tmp_path, slower_targets(first=25)), columns=COLUMNS)
    assert td["time"][0].item() == pytest.approx(0.06)
    assert len(td) == 69
    assert "30 before the first value of an action are left out" in log_messages[0]


def test_a_target_does_not_hold_into_the_next_run(tmp_path):
    rows = slower_targets(40) + slower_targets(40, first=20)
    td = load(write(tmp_path, rows), columns={**COLUMNS, "on_time_jump": "split"})
    assert [float(run["time"][0]) for run in episodes(td)] == pytest.approx([0.0, 0.04])
    for role, values in (("run", [i // 40 for i in range(80)]), ("done", [int(i == 39) for i in range(80)])):
        marked = [(0.002 * i, *row[1:], values[i]) for i, row in enumerate(rows)]
        columns = {**COLUMNS, "columns": [*COLUMNS["columns"], {"name": role, "role": role}]}
        td = load(write(tmp_path, marked, (*NAMES, role)), columns={**columns, "after_done": "new_episode"})
        assert [float(run["time"][0]) for run in episodes(td)] == pytest.approx([0.0, 0.12])


def test_rows_without_readings_are_left_out_behind_their_targets(tmp_path, log_messages):
    """Targets at 500 Hz beside readings at 100 Hz, with stamps between those of the readings."""
    rows = [(0.002 * i + 0.001, None, None, i) for i in range(200)] + [(0.01 * i, 0.1, i, None) for i in range(41)]
    td = load(write(tmp_path, sorted(rows)), columns=COLUMNS)
    assert td["observation"][:, 1].tolist() == list(range(1, 40))
    assert td["action"][:, 0].numpy() == pytest.approx(np.deg2rad(5.0 * np.arange(1, 40) - 1.0), abs=1e-6)
    assert "200 without readings are left out" in log_messages[0]


@pytest.mark.parametrize(
    ("row", "column"),
    [((0.02, None, 0.1, 10), "hip"), ((0.02, None, None, None), "hip"), ((None, 0.1, 0.1, 10), "t")],
)
def test_a_missing_reading_and_an_empty_row_are_refused(tmp_path, row, column):
    rows = slower_targets()
    rows[10] = row
    with pytest.raises(DataError, match="the value is nan, a missing number") as caught:
        load(write(tmp_path, rows), columns=COLUMNS)
    assert (caught.value.column, caught.value.row) == (column, 12)


def test_without_a_time_every_row_needs_readings(tmp_path):
    rows = [(0.1, 0.2, 1.0), (None, None, 1.0), (0.1, 0.3, 1.0), (0.1, 0.4, 1.0)]
    described = {**COLUMNS, "columns": COLUMNS["columns"][1:], "dt": 0.01}
    with pytest.raises(DataError, match="the value is nan"):
        load(write(tmp_path, rows, NAMES[1:]), columns=described)


def test_a_target_without_any_value_is_named(tmp_path):
    with pytest.raises(DataError, match="0 rows have readings and a value of each action"):
        load(write(tmp_path, slower_targets(first=1000)), columns=COLUMNS)


def test_other_formats_have_nan_in_place_of_empty_cells(tmp_path):
    values = np.array(slower_targets(), dtype=float)
    np.savez(tmp_path / "log.npz", **dict(zip(NAMES, values.T, strict=True)))
    held = load(tmp_path / "log.npz", columns=COLUMNS)["action"]
    assert held.tolist() == load(write(tmp_path, slower_targets()), columns=COLUMNS)["action"].tolist()


def test_a_layout_is_guessed_from_targets_and_readings_of_any_rate(tmp_path):
    names = ("t", "hip_pos", "hip_vel", "tau")
    slow = [(0.002 * i, np.sin(0.1 * i), 50.0 * np.cos(0.1 * i), i if i % 10 == 0 else None) for i in range(200)]
    targets = [(0.002 * i + 0.001, None, None, np.sin(i)) for i in range(200)]
    readings = [(0.01 * i, np.sin(0.1 * i), 10.0 * np.cos(0.1 * i), None) for i in range(41)]
    for rows, step in ((slow, 0.002), (sorted(targets + readings), 0.01)):
        path = write(tmp_path, rows, names)
        text = guess_layout(path)
        assert f"the median step is {step:g}," in text
        assert "slope of hip_pos: 1 times this" in text
        layout = LogColumns.load(yaml.safe_load(text))
        assert layout.resample is None
        assert layout.observation == ("hip_pos", "hip_vel")
        assert layout.action == ("tau",)
        assert len(load(path, columns=layout)) > 35
