"""Velocities estimated from positions: their error is as large as is stated."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_h2o.data import Column, DataError, LogColumns, episodes, load, read_robot_log
from torchrl_h2o.data.readers.observed import estimated_velocities, words_of_estimates
from torchrl_h2o.data.readers.velocity import estimate_velocity

LAYOUT = LogColumns(
    (
        Column("t", "time", "s"),
        Column("q", "observation", "deg"),
        Column("w", "observation", derivative_of="q"),
        Column("u", "action"),
    ),
    separator=",",
    header=True,
    on_time_jump="split",
)


def motion(time):
    return np.sin(3 * time) + 0.5 * np.sin(11 * time + 1), 3 * np.cos(3 * time) + 5.5 * np.cos(11 * time + 1)


@settings(max_examples=6, deadline=None)
@given(
    dt=st.sampled_from([0.002, 0.005, 0.01]),
    noise=st.sampled_from([1e-4, 1e-3, 1e-2]),
    step=st.sampled_from([None, 1.5e-3]),
    seed=st.integers(0, 100),
)
def test_the_error_is_as_large_as_it_says(dt, noise, step, seed):
    time = dt * np.arange(2000)
    position, velocity = motion(time)
    measured = position + np.random.default_rng(seed).normal(0, noise, 2000)
    if step is not None:  # of an encoder
        measured = np.round(measured / step) * step
    found = estimate_velocity(measured, [slice(0, 2000)], dt)
    error = np.sqrt(np.nanmean((found.velocity - velocity) ** 2))
    assert 0.7 < found.std / error < 1.5
    assert error < 0.3 * np.sqrt(np.mean((np.gradient(measured, dt) - velocity) ** 2))


def test_the_window_grows_with_the_noise():
    time = 0.005 * np.arange(3000)
    noise = np.random.default_rng(0).normal(0, 1, 3000)
    windows = [
        estimate_velocity(motion(time)[0] + size * noise, [slice(0, 3000)], 0.005).window for size in (1e-4, 1e-2)
    ]
    assert windows[0] < windows[1]


def test_no_window_reaches_over_the_end_of_a_run():
    time = 0.01 * np.arange(200)
    first, second = np.sin(time), 100 + np.cos(time)
    runs = [slice(0, 200), slice(200, 400)]
    found = estimate_velocity(np.concatenate([first, second]), runs, 0.01)
    alone = np.isnan(found.velocity)
    half = found.window // 2
    assert alone.nonzero()[0].tolist() == [
        *range(half), *range(200 - half, 200 + half), *range(400 - half, 400)
    ]  # fmt: skip
    assert np.nanmax(np.abs(found.velocity)) < 1.01


def test_an_angle_may_be_wrapped_and_a_length_may_jump():
    time = 0.01 * np.arange(1000)
    wrapped = np.angle(np.exp(2j * time))
    found = estimate_velocity(wrapped, [slice(0, 1000)], 0.01, angle=True)
    assert np.nanmax(np.abs(found.velocity - 2)) < 1e-9
    assert np.nanmax(np.abs(estimate_velocity(wrapped, [slice(0, 1000)], 0.01).velocity)) > 3


def test_a_position_at_rest_has_no_velocity():
    found = estimate_velocity(np.full(100, 0.3), [slice(0, 100)], 0.01)
    assert np.nanmax(np.abs(found.velocity)) < 1e-9
    assert found.std < 1e-9


def write(path, time, position):
    rows = "".join(f"{t:.9g},{np.rad2deg(q):.9g},0\n" for t, q in zip(time, position, strict=True))
    path.write_text("t,q,u\n" + rows)
    return path


def test_a_log_without_velocities_is_read_with_estimates(tmp_path, log_messages):
    time = 0.005 * np.arange(1000)
    time[600:] += 1.0  # a gap, at which the run is split
    position, velocity = motion(time)
    noisy = position + np.random.default_rng(0).normal(0, 1e-3, 1000)
    td = read_robot_log(write(tmp_path / "log.csv", time, noisy), LAYOUT)
    rows = np.searchsorted(time, td["time"].flatten().numpy() - 1e-6)
    torch.testing.assert_close(td["observation"][:, 0], torch.from_numpy(noisy[rows]).float(), rtol=1e-5, atol=1e-6)
    std = td["observation_std"]
    assert std.shape == td["observation"].shape
    assert std[:, 0].unique().tolist() == [0.0]
    error = (td["observation"][:, 1] - torch.from_numpy(velocity[rows])).std()
    assert 0.7 < std[0, 1] / error < 1.4
    runs = list(episodes(td))
    assert len(runs) == 2
    for run in runs:
        assert torch.equal(run["next", "observation"][:-1], run["observation"][1:])
        assert run["next", "truncated"].flatten().nonzero().flatten().tolist() == [len(run) - 1]
    (estimate,) = estimated_velocities(td, LAYOUT)
    assert (estimate.name, estimate.position, estimate.unit) == ("w", "q", "rad/s")
    assert f"with an error of {std[0, 1]:.2g} rad/s" in words_of_estimates([estimate])
    assert any("w is estimated from q over" in message for message in log_messages)


def test_each_of_several_logs_has_an_error_of_its_own(tmp_path):
    time, rng = 0.005 * np.arange(500), np.random.default_rng(0)
    sizes = (1e-4, 1e-2)
    paths = [write(tmp_path / f"{size}.csv", time, motion(time)[0] + rng.normal(0, size, 500)) for size in sizes]
    td = load(paths, columns=LAYOUT)
    stds = [td["observation_std"][td["log"] == index, 1].unique().item() for index in (0, 1)]
    assert stds[1] > 3 * stds[0]
    (estimate,) = estimated_velocities(td, LAYOUT)
    assert min(stds) < estimate.std < max(stds)


def test_runs_that_are_too_short_are_refused(tmp_path):
    time = 0.01 * np.arange(7)
    with pytest.raises(DataError, match="the longest run has 7 rows, but a velocity is estimated from 8") as caught:
        read_robot_log(write(tmp_path / "log.csv", time, np.sin(time)), LAYOUT)
    assert caught.value.column == "w"
    eight = 0.01 * np.arange(8)
    assert len(read_robot_log(write(tmp_path / "log.csv", eight, np.sin(eight)), LAYOUT)) == 1


@pytest.mark.parametrize("name", ["excitation_pd", "swing_up_energy"])
def test_a_real_pendulum_s_velocity_is_found_without_its_column(shared_data, name):
    path = shared_data / "simple_pendulum" / f"{name}.csv"
    columns = (
        Column("time", "time", "s"),
        Column("position", "observation", "rad"),
        Column("velocity", "observation", "rad/s"),
        Column("torque", "action", "N·m"),
    )
    options = {"separator": ",", "header": True, "on_time_jump": "split", "drop_trailing_zero_rows": True}
    measured = load(path, columns=LogColumns(columns, **options))
    guessed = (columns[0], columns[1], Column("rate", "observation", derivative_of="position"), columns[3])
    estimated = load(path, columns=LogColumns(guessed, **options, other_columns="ignore"))
    same = np.isin(measured["time"].flatten(), estimated["time"].flatten())
    pair = torch.stack([measured["observation"][same, 1], estimated["observation"][:, 1]])
    assert torch.corrcoef(pair)[0, 1] > 0.96
