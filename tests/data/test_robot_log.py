"""Robot logs: transitions from rows, dropped rows, and the location of invalid values."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from torchrl_h2o.data import Column, DataError, LogColumns, episodes, read_robot_log

WHEELS = LogColumns(
    (
        Column("x", "observation", "mm"),
        Column("tau", "action", "N·m", bounds=(-3, 3)),
        Column("done", "done"),
    ),
    dt=0.005,
)
TIMED = LogColumns(
    (Column("t", "time", "ms"), Column("q", "observation", "deg"), Column("u", "action")),
    separator=",",
    header=True,
)


def changed(layout, **changes):
    """Returns a layout with some options changed."""
    return LogColumns(**{**vars(layout), **changes})


def write(tmp_path, text, name="log.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def timed(tmp_path, rows):
    return write(tmp_path, "t,q,u\n" + "".join(f"{t},{q},{u}\n" for t, q, u in rows))


def test_rows_become_transitions_in_si(tmp_path):
    td = read_robot_log(write(tmp_path, "0 1 0\n1000 2 0\n2000 -3 0\n"), WHEELS)
    assert td["observation"].tolist() == [[0], [1]]
    assert td["next", "observation"].tolist() == [[1], [2]]
    assert td["action"].tolist() == [[1], [2]]
    assert td["time"].flatten().tolist() == [0, 0.005]
    assert td["next", "truncated"].flatten().tolist() == [False, True]
    assert ("next", "reward") not in td.keys(True)


def test_first_done_row_is_the_terminal_state_and_the_rest_is_dropped(tmp_path, log_messages):
    td = read_robot_log(write(tmp_path, "0 0 0\n1 0 0\n2 9 1\n3 0 1\n4 0 1\n"), WHEELS)
    torch.testing.assert_close(td["next", "observation"].flatten(), torch.tensor([1e-3, 2e-3]))
    assert td["next", "terminated"].flatten().tolist() == [False, True]
    assert td["next", "done"].flatten().tolist() == [False, True]
    assert not td["next", "truncated"].any()
    assert "2 transitions from 5 rows" in log_messages[-1]
    assert "2 rows dropped because they belong to no transition" in log_messages[-1]


def test_rows_behind_the_end_have_to_be_declared(tmp_path):
    path = write(tmp_path, "0 0 0\n1 0 1\n2 0 0\n3 0 0\n")
    with pytest.raises(DataError, match="after_done: drop, or after_done: new_episode") as caught:
        read_robot_log(path, WHEELS)
    assert (caught.value.column, caught.value.row) == ("done", 3)
    assert len(read_robot_log(path, changed(WHEELS, after_done="drop"))) == 1
    found = list(episodes(read_robot_log(path, changed(WHEELS, after_done="new_episode"))))
    assert [episode["observation"].flatten().tolist() for episode in found] == [
        [0.0],
        [pytest.approx(2e-3)],
    ]


@settings(max_examples=15, deadline=None)
@given(st.lists(st.booleans(), min_size=2, max_size=12))
def test_no_transition_leaves_a_done_row_or_links_two_runs(tmp_path_factory, done):
    lines = [f"{1000 * i} 0 {int(ended)}\n" for i, ended in enumerate(done)]
    path = write(tmp_path_factory.mktemp("log"), "".join(lines))
    expected = [i for i in range(len(done) - 1) if not done[i]]
    layout = changed(WHEELS, after_done="new_episode")
    if not expected:
        with pytest.raises(DataError, match="no two rows make a transition"):
            read_robot_log(path, layout)
        return
    td = read_robot_log(path, layout)
    assert td["observation"].flatten().tolist() == expected
    assert torch.equal(td["next", "observation"], td["observation"] + 1)
    assert td["next", "terminated"].flatten().tolist() == [done[i + 1] for i in expected]
    for episode in episodes(td):
        assert torch.equal(episode["next", "observation"][:-1], episode["observation"][1:])


def test_header_names_the_columns_in_any_order(tmp_path):
    td = read_robot_log(write(tmp_path, "u,t,q\n1,0,180\n2,10,90\n3,20,0\n"), TIMED)
    assert td["action"].flatten().tolist() == [1, 2]
    torch.testing.assert_close(td["observation"][0, 0], torch.tensor(torch.pi))
    torch.testing.assert_close(td["time"].flatten(), torch.tensor([0, 0.01]).double())


def test_ignored_columns_may_hold_anything(tmp_path):
    layout = changed(WHEELS, columns=(*WHEELS.columns, Column("mode", "ignore")))
    assert len(read_robot_log(write(tmp_path, "0 0 0 idle\n1 0 0 nan\n"), layout)) == 1


def test_reward_comes_from_a_function(tmp_path):
    path = write(tmp_path, "1000 2 0\n3000 9 0\n5000 0 1\n")

    def reward(observation, action, following):
        return (100 * observation + 10 * action + following)[:, 0]

    td = read_robot_log(path, changed(WHEELS, outside_bounds="clip"), reward=reward)
    assert td["next", "reward"].flatten().tolist() == [123, 335]


def test_reward_column_is_what_the_action_of_its_row_earned(tmp_path):
    layout = changed(WHEELS, columns=(*WHEELS.columns, Column("r", "reward")))
    path = write(tmp_path, "0 0 0 7\n1 0 0 8\n2 0 1 9\n")
    assert read_robot_log(path, layout)["next", "reward"].flatten().tolist() == [7, 8]
    with pytest.raises(DataError, match="reward column and a reward function"):
        read_robot_log(path, layout, reward=lambda *transition: np.zeros(2))


def test_reward_function_is_checked(tmp_path):
    path = write(tmp_path, "0 0 0\n1 0 0\n2 0 0\n")
    with pytest.raises(DataError, match=r"returned the shape \[3\].*must return \[2\]"):
        read_robot_log(path, WHEELS, reward=lambda *transition: np.zeros(3))
    with pytest.raises(DataError, match="the value is nan") as caught:
        read_robot_log(path, WHEELS, reward=lambda *transition: np.array([0, np.nan]))
    assert caught.value.row == 2


def test_action_outside_its_bounds_is_an_error_or_clipped(tmp_path, log_messages):
    path = write(tmp_path, "0 0 0\n1 -4 0\n2 8 0\n3 99 0\n")
    with pytest.raises(DataError, match=r"action -4 lies outside \[-3, 3\]") as caught:
        read_robot_log(path, WHEELS)
    assert (caught.value.column, caught.value.row) == ("tau", 2)
    later = write(tmp_path, "0 0 0\n1 0 1\n2 0 1\n3 0 0\n4 5 0\n5 0 0\n", "later.txt")
    with pytest.raises(DataError, match="action 5 lies outside") as caught:
        read_robot_log(later, changed(WHEELS, after_done="new_episode"))
    assert caught.value.row == 5
    td = read_robot_log(path, changed(WHEELS, outside_bounds="clip"))
    assert td["action"].flatten().tolist() == [0, -3, 3]
    assert "2 actions clipped" in log_messages[-1]


def test_time_that_runs_backwards_is_an_error_even_where_runs_are_split(tmp_path):
    path = timed(tmp_path, [(0, 1, 0), (10, 1, 0), (20, 1, 0), (15, 1, 0), (25, 1, 0)])
    for layout in (TIMED, changed(TIMED, on_time_jump="split")):
        with pytest.raises(DataError, match=r"time goes from 0.02 s to 0.015 s") as caught:
            read_robot_log(path, layout)
        assert (caught.value.column, caught.value.row) == ("t", 5)


def test_time_that_jumps_is_an_error_or_splits_the_run(tmp_path):
    path = timed(tmp_path, [(0, 1, 0), (10, 2, 0), (20, 3, 0), (50, 4, 0), (60, 5, 0)])
    with pytest.raises(DataError, match=r"step is 0.03 s, dt is 0.01 s.*on_time_jump") as caught:
        read_robot_log(path, TIMED)
    assert (caught.value.column, caught.value.row) == ("t", 5)
    found = list(episodes(read_robot_log(path, changed(TIMED, on_time_jump="split"))))
    assert [len(episode) for episode in found] == [2, 1]
    assert found[0]["next", "truncated"][-1]


def test_time_that_hardly_moves_is_irregular_too(tmp_path):
    path = timed(tmp_path, [(0, 1, 0), (10, 2, 0), (20, 3, 0), (21, 4, 0), (31, 5, 0)])
    with pytest.raises(DataError, match=r"step is 0.001 s, dt is 0.01 s") as caught:
        read_robot_log(path, TIMED)
    assert caught.value.row == 5


def test_stated_dt_is_held_against_the_time_column(tmp_path):
    path = timed(tmp_path, [(0, 1, 0), (10, 2, 0), (20, 3, 0)])
    assert len(read_robot_log(path, changed(TIMED, dt=0.01))) == 2
    assert len(read_robot_log(path, changed(TIMED, dt=0.0101))) == 2
    for wrong in (0.005, 0.0097, 0.0103, 1e3):
        with pytest.raises(DataError, match=f"median time step is 0.01 s, dt is {wrong:g} s") as caught:
            read_robot_log(path, changed(TIMED, dt=wrong))
        assert caught.value.column == "t"
    coarse = timed(tmp_path, [(10 * i // 3, i, 0) for i in range(31)])  # 300 Hz with a clock resolution of 1 ms
    assert len(read_robot_log(coarse, changed(TIMED, dt=1 / 300))) == 30


def test_times_are_told_exactly_where_a_run_is_long(tmp_path):
    path = timed(tmp_path, [(1234567.89, 1, 0), (1234577.89, 1, 0), (1234577.88, 1, 0)])
    with pytest.raises(DataError, match=r"from 1234.57789 s to 1234.57788 s"):
        read_robot_log(path, TIMED)


def test_trailing_zero_rows_are_dropped_only_when_asked(tmp_path, log_messages):
    path = timed(tmp_path, [(0, 0, 0), (10, 2, 0), (20, 3, 0), (0, 0, 0), (0, 0, 0)])
    with pytest.raises(DataError, match="set drop_trailing_zero_rows"):
        read_robot_log(path, TIMED)
    td = read_robot_log(path, changed(TIMED, drop_trailing_zero_rows=True))
    assert len(td) == 2
    assert "2 zero rows dropped at the end" in log_messages[-1]
    with pytest.raises(DataError, match="only rows of zeros"):
        read_robot_log(timed(tmp_path, [(0, 0, 0)] * 5), changed(TIMED, drop_trailing_zero_rows=True))


@settings(max_examples=10, deadline=None)
@given(
    row=st.integers(0, 5),
    column=st.integers(0, 3),
    bad=st.sampled_from(["nan", "inf", "-inf", "1e60", "", "one", "1.2.3"]),
    blank=st.integers(0, 3),
)
def test_any_bad_value_is_named_by_line_and_column(tmp_path_factory, row, column, bad, blank):
    assume(column < 3 or bad not in ("nan", ""))  # a missing action is the last one
    cells = [[str(100 * i + 10 * j) for j in range(4)] for i in range(6)]
    cells[row][column] = bad
    text = "t,q,v,u\n" + "\n" * blank + "".join(",".join(line) + "\n" for line in cells)
    columns = (*TIMED.columns[:2], Column("v", "observation"), TIMED.columns[2])
    layout = LogColumns(columns, separator=",", header=True)
    with pytest.raises(DataError) as caught:
        read_robot_log(write(tmp_path_factory.mktemp("log"), text), layout)
    assert caught.value.column == "tqvu"[column]
    assert caught.value.row == 2 + blank + row


@pytest.mark.parametrize(
    ("text", "column", "row", "message"),
    [
        ("t,q\n0,1\n1,1\n", "u", 1, "the column is missing"),
        ("t,q,u,w\n0,1,1,1\n", "w", 1, "not described"),
        ("t,q,q,u\n0,1,1,1\n", "q", 1, "two columns have this name"),
        ("t,q,u\n0,1,2\n1,1,2,3\n2,1,2\n", "column 4", 3, "has 4 columns, 3 are expected"),
        ("t,q,u\n0,1,2\n1,1\n2,1,2\n", "u", 3, "has 2 columns, 3 are expected"),
        ("t,q,u\n0,1,2\n1,1,2\n2,1", "u", 4, "the file is truncated"),
        ("t,q,u\n", None, None, "0 rows of data"),
        ("t,q,u\n0,1,2\n", None, None, "1 rows of data"),
        ("", None, None, "the file is empty"),
        ("\n\n", None, None, "0 rows of data"),
    ],
)
def test_misshapen_file_is_refused(tmp_path, text, column, row, message):
    with pytest.raises(DataError, match=message) as caught:
        read_robot_log(write(tmp_path, text), TIMED)
    assert (caught.value.column, caught.value.row) == (column, row)
    assert caught.value.source.endswith("log.txt")


def test_done_other_than_zero_and_one_is_refused(tmp_path):
    with pytest.raises(DataError, match="the flag is 2") as caught:
        read_robot_log(write(tmp_path, "0 0 0\n1 0 2\n"), WHEELS)
    assert (caught.value.column, caught.value.row) == ("done", 2)


def test_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "log.txt"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(DataError, match="not text"):
        read_robot_log(path, WHEELS)


def test_windows_line_ends_and_byte_order_mark_are_read(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes("\ufefft,q,u\r\n0,1,2\r\n10,1,2\r\n".encode())
    assert len(read_robot_log(path, TIMED)) == 1


@pytest.mark.parametrize(
    ("layout", "order"),
    [
        ("wheel_legged_standing_still", [2, 3, 0, 1]),
        ("wheel_legged_moving_forward", [1, 2, 3]),
    ],
)
def test_real_wheel_legged_robot(shared_data, log_messages, layout, order):
    path = shared_data / "wheel_legged" / "standing_still.txt"
    td = read_robot_log(path, layout)
    raw = np.loadtxt(path)
    end = int(np.argmax(raw[:, 5]))  # the robot has fallen here
    states = torch.from_numpy(raw[: end + 1, order]).float()
    assert torch.equal(td["observation"], states[:-1])
    assert torch.equal(td["next", "observation"], states[1:])
    torques = torch.from_numpy(raw[:end, 4]).float().clamp(-3, 3)
    assert torch.equal(td["action"].flatten(), torques)
    assert td["next", "terminated"].flatten().nonzero().tolist() == [[end - 1]]
    pitch = states[:, order.index(2)].abs()
    assert pitch[-1] > torch.pi / 6 > pitch[:-1].max()
    assert f"{len(raw) - end - 1} rows dropped" in log_messages[-1]


@pytest.mark.parametrize(
    ("name", "transitions", "dt"),
    [("excitation_pd", 1169, 1 / 300), ("swing_up_energy", 3999, 0.005), ("swing_up_sac", 7998, 0.005)],
)
def test_real_pendulum(shared_data, name, transitions, dt):
    td = read_robot_log(shared_data / "simple_pendulum" / f"{name}.csv", "simple_pendulum")
    assert len(td) == transitions
    steps = td["time"].diff(dim=0)
    torch.testing.assert_close(steps.median(), torch.tensor(dt).double(), rtol=1e-3, atol=0)
    assert steps.max() < 1.5 * dt
    # the logged velocity is the derivative of the position, up to noise
    moved = (td["next", "observation"] - td["observation"])[:, 0] / dt
    assert torch.corrcoef(torch.stack([moved, td["observation"][:, 1]]))[0, 1] > 0.9


AGAIN = [(10 * (i % 20), i, 0) for i in range(60)]  # time in ms, begins again every 20 rows


@pytest.mark.parametrize("resample", [None, 0.01])
def test_a_run_begins_where_time_begins_again(tmp_path, resample):
    path = timed(tmp_path, AGAIN)
    with pytest.raises(DataError, match="set on_time_jump: split") as caught:
        read_robot_log(path, changed(TIMED, resample=resample))
    assert caught.value.row == 22
    found = list(episodes(read_robot_log(path, changed(TIMED, on_time_jump="split", resample=resample))))
    assert [len(run) for run in found] == [19, 19, 19]
    assert [float(run["time"][0]) for run in found] == [0, 0, 0]


def test_rows_out_of_order_begin_no_run(tmp_path):
    path = timed(tmp_path, [*AGAIN[:10], (85, 9, 0), *AGAIN[10:20]])
    with pytest.raises(DataError, match="time must increase"):
        read_robot_log(path, changed(TIMED, on_time_jump="split"))


@pytest.mark.parametrize("resample", [None, 0.01])
def test_a_run_ends_where_its_number_changes(tmp_path, resample):
    rows = [(10 * i, i, 0, i // 20) for i in range(60)]
    text = "t,q,u,episode\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)
    layout = changed(TIMED, columns=(*TIMED.columns, Column("episode", "run")), resample=resample)
    found = list(episodes(read_robot_log(write(tmp_path, text), layout)))
    assert [len(run) for run in found] == [19, 19, 19]


def test_a_layout_may_be_a_mapping(tmp_path):
    entries = {"dt": 0.01, "columns": [{"name": "q", "role": "observation"}, {"name": "u", "role": "action"}]}
    path = write(tmp_path, "1 2\n3 4\n")
    assert read_robot_log(path, entries)["action"].item() == 2.0
    with pytest.raises(DataError, match="columns: unknown entry 'q'; choose from columns, dt"):
        read_robot_log(path, {"q": "observation"})
    with pytest.raises(DataError, match="columns=3 describes no columns"):
        read_robot_log(path, 3)
