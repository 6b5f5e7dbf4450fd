"""Logs with irregular time stamps, on a regular clock."""

import numpy as np
import pytest

from torchrl_h2o.data import Column, DataError, LogColumns, episodes, read_robot_log

COLUMNS = (Column("t", "time", "s"), Column("q", "observation", "rad"), Column("u", "action", "N·m"))


def layout(columns=COLUMNS, **options):
    return LogColumns(columns, separator=",", header=True, **{"resample": 0.01, **options})


def read(tmp_path, rows, described=None, names="t,q,u"):
    path = tmp_path / "log.csv"
    path.write_text(names + "\n" + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows))
    return read_robot_log(path, described or layout())


def irregular(count=400, seed=0):
    """Stamps about 10 ms apart, with a scatter of 2 ms."""
    return np.cumsum(0.01 + 0.002 * np.random.default_rng(seed).uniform(-1, 1, count))


def test_motion_is_read_between_irregular_stamps(tmp_path):
    time = irregular()
    td = read(tmp_path, np.c_[time, np.sin(2 * time), np.cos(time)])
    clock = td["time"].flatten().numpy()
    assert np.diff(clock) == pytest.approx(0.01)
    assert clock[0] == time[0]
    assert len(td) == int((time[-1] - time[0]) / 0.01)
    assert td["observation"].flatten().numpy() == pytest.approx(np.sin(2 * clock), abs=1e-4)
    assert td["next", "observation"].flatten().numpy() == pytest.approx(np.sin(2 * (clock + 0.01)), abs=1e-4)


def test_a_regular_log_stays_as_it_is(tmp_path):
    time = 0.01 * np.arange(50)
    rows = np.c_[time, time**2, np.arange(50) % 3]
    same, before = read(tmp_path, rows), read(tmp_path, rows, layout(resample=None))
    assert same["observation"].numpy() == pytest.approx(before["observation"].numpy(), abs=1e-6)
    assert same["action"].numpy() == pytest.approx(before["action"].numpy(), abs=1e-6)


def test_an_action_is_the_mean_of_what_was_held_over_its_step(tmp_path):
    td = read(tmp_path, [(0.0, 0, 4), (0.005, 0, 0), (0.0125, 0, 8), (0.02, 1, 8)])
    assert td["action"].flatten().tolist() == pytest.approx([0.5 * 4, 0.75 * 8])


def test_angles_are_interpolated_across_their_jump(tmp_path):
    true = np.linspace(3.0, 3.3, 7)
    time = np.array([0.0, 0.011, 0.019, 0.032, 0.04, 0.051, 0.06])
    true = 3.0 + 5.0 * time
    wrapped = (true + np.pi) % (2 * np.pi) - np.pi
    td = read(tmp_path, np.c_[time, wrapped, 0 * time])
    clock = td["time"].flatten().numpy()
    error = td["observation"].flatten().numpy() - (3.0 + 5.0 * clock)
    assert np.abs(error - 2 * np.pi * np.round(error / (2 * np.pi))).max() < 1e-5
    assert (np.abs(td["observation"].numpy()) < np.pi + 0.06).all()


def test_readings_that_repeat_after_a_lost_packet_are_not_used(tmp_path, log_messages):
    time = 0.01 * np.arange(30)
    position = 2.0 * time
    position[10:12] = position[9]
    td = read(tmp_path, np.c_[time, position, 0 * time])
    assert td["observation"].flatten().numpy() == pytest.approx(2.0 * td["time"].flatten().numpy(), abs=1e-6)
    assert "readings of 2 rows repeat the row before" in " ".join(log_messages)


def test_a_robot_that_rests_keeps_its_readings(tmp_path):
    time = 0.01 * np.arange(60)
    position = np.where(time < 0.3, 0.0, 1.0)
    td = read(tmp_path, np.c_[time, position, 0 * time])
    assert td["observation"].flatten().tolist() == pytest.approx(position[:-1].tolist())


def test_runs_end_at_gaps_if_the_layout_says_so(tmp_path):
    time = np.concatenate([irregular(50), 1.0 + irregular(50, seed=1)])
    rows = np.c_[time, time, 0 * time]
    with pytest.raises(DataError, match=r"row 52.*time_tolerance allows interpolation over 0\.015"):
        read(tmp_path, rows)
    td = read(tmp_path, rows, layout(on_time_jump="split"))
    assert len(list(episodes(td))) == 2
    assert td["observation"].flatten().numpy() == pytest.approx(td["time"].flatten().numpy(), abs=1e-6)


def test_an_episode_ends_with_the_last_step_before_its_done(tmp_path):
    columns = (*COLUMNS, Column("done", "done"))
    time = np.array([0.0, 0.012, 0.021, 0.033, 0.5, 0.512, 0.521])
    rows = np.c_[time, time, 0 * time, [0, 0, 0, 1, 0, 0, 0]]
    td = read(tmp_path, rows, layout(columns, after_done="new_episode"), names="t,q,u,done")
    assert td["next", "terminated"].flatten().tolist() == [False, False, True, False, False]
    assert td["time"].flatten().tolist() == pytest.approx([0.0, 0.01, 0.02, 0.5, 0.51])
    dropped = read(tmp_path, rows, layout(columns, after_done="drop"), names="t,q,u,done")
    assert len(dropped) == 3


def test_time_must_increase(tmp_path):
    with pytest.raises(DataError, match="time must increase"):
        read(tmp_path, [(0.0, 0, 0), (0.02, 1, 0), (0.01, 2, 0)])


def test_a_log_shorter_than_a_step_is_refused(tmp_path):
    with pytest.raises(DataError, match="no run is as long as a step of 1 s"):
        read(tmp_path, [(0.0, 0, 0), (0.02, 1, 0)], layout(resample=1.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resample": 0.0}, "positive number"),
        ({"dt": 0.01}, "give one of resample and dt"),
        ({"columns": (*COLUMNS, Column("r", "reward"))}, "rewards belong to the steps of the file"),
    ],
)
def test_contradictions_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        layout(**options)


def test_the_step_is_read_from_yaml(tmp_path):
    path = tmp_path / "log.yaml"
    path.write_text(
        "resample: 5e-3\ncolumns:\n  - {name: t, role: time, unit: s}\n  - {name: q, role: observation}\n"
        "  - {name: u, role: action}\n"
    )
    assert LogColumns.load(path).resample == 0.005


def test_velocities_can_be_estimated_and_know_the_noise_of_the_file(tmp_path):
    """Interpolated positions look smoother than the file's: their noise would be taken for smaller than it is."""
    columns = (*COLUMNS, Column("w", "observation", derivative_of="q"))
    time = irregular(2000)
    position = np.sin(2 * time) + np.random.default_rng(1).normal(0.0, 1e-3, len(time))
    for step in (0.01, 0.005):
        td = read(tmp_path, np.c_[time, position, 0 * time], layout(columns, resample=step, observation=("q", "w")))
        error = td["observation"][:, 1].numpy() - 2 * np.cos(2 * td["time"].flatten().numpy())
        assert 0.6 < float(td["observation_std"][0, 1]) / error.std() < 2.0
        assert error.std() < 0.02


def test_an_angle_that_counts_its_turns_does_not_jump(tmp_path):
    time = np.cumsum(0.05 + 0.01 * np.random.default_rng(0).uniform(-1, 1, 40))
    td = read(tmp_path, np.c_[time, 100.0 * time, 0 * time], layout(resample=0.05))
    assert td["observation"].flatten().numpy() == pytest.approx(100.0 * td["time"].flatten().numpy(), rel=1e-5)


def test_a_run_ends_with_its_last_fresh_reading(tmp_path):
    time = 0.01 * np.arange(30)
    position = np.minimum(2.0 * time, 2.0 * time[25])
    td = read(tmp_path, np.c_[time, position, 0 * time])
    assert float(td["next", "observation"][-1]) == pytest.approx(2.0 * time[25])
    assert len(td) == 25


@pytest.mark.parametrize("step", [1e-9, 1e-4])
def test_a_step_far_below_the_log_s_own_is_refused(tmp_path, step):
    rows = np.c_[irregular(40), np.zeros((40, 2))]
    with pytest.raises(DataError, match=r"rows from 40; give at least 0\.0002"):
        read(tmp_path, rows, layout(resample=step))


def test_a_bridged_gap_counts_as_well(tmp_path):
    time = np.append(irregular(40), 1e8)
    with pytest.raises(DataError, match=r"gives 1e\+10 rows from 41"):
        read(tmp_path, np.c_[time, np.zeros((41, 2))], layout(time_tolerance=1e12))
