"""D4RL files, with and without next_observations."""

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.data.recordings import assert_same, make_arrays, make_recording
from torchrl_h2o.data import DataError, episodes, load, read_d4rl

ENDINGS = (True, False, False)
LENGTHS = (4, 1, 3)


def write(path, **changes):
    """Writes a D4RL file; ``changes`` replaces arrays, None omits one."""
    made = make_arrays(LENGTHS, ENDINGS)
    arrays = {
        "observations": made["observation"],
        "next_observations": made["next_observation"],
        "actions": made["action"],
        "rewards": made["reward"],
        "terminals": made["terminated"],
        "timeouts": made["truncated"],
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            if values is not None:
                file[name] = values
        file["metadata/algorithm"] = "made up"
        file["infos/qpos"] = np.zeros((8, 2))
    return path


def test_file_with_next_observations_is_read_whole(tmp_path):
    assert_same(load(write(tmp_path / "a.hdf5")), make_recording(LENGTHS, ENDINGS))


def test_without_next_observations_no_row_links_two_episodes(tmp_path, log_messages):
    td = read_d4rl(write(tmp_path / "a.hdf5", next_observations=None))
    rows = torch.tensor([0, 1, 2, 5, 6])  # 3, 4 and 7 are the last rows of their episodes
    whole = make_recording(LENGTHS, ENDINGS)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert torch.equal(td[key], whole[key][rows])
    assert td["next", "truncated"].flatten().tolist() == [False, False, True, False, True]
    assert not td["next", "terminated"].any()
    assert "3 of 8 rows dropped" in log_messages[-1]


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.integers(2, 5), st.booleans()), min_size=1, max_size=6))
def test_observations_chain_inside_episodes_only(tmp_path_factory, drawn):
    lengths, endings = zip(*drawn, strict=True)
    made = make_arrays(lengths, endings)
    path = write(
        tmp_path_factory.mktemp("d4rl") / "a.hdf5",
        next_observations=None,
        observations=made["observation"],
        actions=made["action"],
        rewards=made["reward"],
        terminals=made["terminated"],
        timeouts=made["truncated"],
    )
    found = list(episodes(read_d4rl(path)))
    assert [len(episode) for episode in found] == [length - 1 for length in lengths]
    for episode in found:
        assert torch.equal(episode["next", "observation"][:-1], episode["observation"][1:])


def test_episode_cut_by_the_end_of_the_file_is_truncated(tmp_path):
    one = make_arrays((8,), (False,))
    one = {"observations": one["observation"], "next_observations": one["next_observation"]}
    td = read_d4rl(write(tmp_path / "a.hdf5", timeouts=np.zeros(8), terminals=np.zeros(8), **one))
    assert td["next", "truncated"].flatten().tolist() == [False] * 7 + [True]
    td = read_d4rl(write(tmp_path / "b.hdf5", timeouts=np.zeros(8), next_observations=None))
    assert td["next", "truncated"].flatten().tolist() == [False, False, True, False, False, True]


@settings(max_examples=7, deadline=None)
@given(st.lists(st.integers(1, 4), min_size=1, max_size=5))
def test_episodes_without_flags_are_not_linked(tmp_path_factory, lengths):
    made = make_arrays(lengths, [False] * len(lengths))
    path = write(
        tmp_path_factory.mktemp("d4rl") / "a.hdf5",
        observations=made["observation"],
        next_observations=made["next_observation"],
        actions=made["action"],
        rewards=made["reward"],
        terminals=np.zeros(sum(lengths)),
        timeouts=np.zeros(sum(lengths)),
    )
    assert_same(read_d4rl(path), make_recording(lengths, [False] * len(lengths)))


def test_jumps_without_a_flag_are_counted_in_the_log(tmp_path, log_messages):
    read_d4rl(write(tmp_path / "a.hdf5", timeouts=np.zeros(8)))
    assert "1 of 8 rows are marked truncated" in log_messages[-1]
    log_messages.clear()
    read_d4rl(write(tmp_path / "b.hdf5"))
    assert not log_messages


def test_rewards_and_flags_may_be_columns(tmp_path):
    made = make_arrays(LENGTHS, ENDINGS)
    columns = {"rewards": "reward", "terminals": "terminated", "timeouts": "truncated"}
    path = write(tmp_path / "a.hdf5", **{name: made[key][:, None] for name, key in columns.items()})
    assert_same(read_d4rl(path), make_recording(LENGTHS, ENDINGS))


@pytest.mark.parametrize("name", ["terminals", "timeouts"])
@pytest.mark.parametrize("bad", [2, -1, 0.5])
def test_flag_other_than_zero_and_one_is_refused(tmp_path, name, bad):
    flags = np.zeros(8)
    flags[5] = bad
    with pytest.raises(DataError, match=f"flag is {bad}") as caught:
        read_d4rl(write(tmp_path / "a.hdf5", **{name: flags}))
    assert (caught.value.column, caught.value.row) == (name, 6)


def test_without_timeouts_runs_end_where_the_next_observation_is_not_the_following_row(tmp_path):
    found = read_d4rl(write(tmp_path / "a.hdf5", timeouts=None))
    assert_same(found, make_recording(LENGTHS, ENDINGS))
    with pytest.raises(DataError, match="has no timeouts or next_observations; it has "):
        read_d4rl(write(tmp_path / "b.hdf5", timeouts=None, next_observations=None))


@pytest.mark.parametrize("name", ["observations", "actions", "rewards", "terminals"])
def test_missing_array_is_named(tmp_path, name):
    with pytest.raises(DataError, match=f"has no {name}; it has ") as caught:
        read_d4rl(write(tmp_path / "a.hdf5", **{name: None}))
    assert caught.value.column == name


def test_arrays_of_different_lengths_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"'actions'.*7 rows, observations has 8"):
        read_d4rl(write(tmp_path / "a.hdf5", actions=np.zeros((7, 2))))


def test_array_of_the_wrong_kind_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"'actions'.*1 dimensions"):
        read_d4rl(write(tmp_path / "a.hdf5", actions=np.zeros(8)))
    with pytest.raises(DataError, match=r"'rewards'.*object"):
        read_d4rl(write(tmp_path / "b.hdf5", rewards=["one"] * 8))
    with pytest.raises(DataError, match=r"'next_observations'.*\[8, 2\]"):
        read_d4rl(write(tmp_path / "c.hdf5", next_observations=np.zeros((8, 2))))


@settings(max_examples=7, deadline=None)
@given(
    st.integers(0, 7),
    st.sampled_from([("observations", 2), ("actions", 1), ("rewards", None)]),
    st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_any_value_that_is_not_finite_is_named(tmp_path_factory, row, place, bad):
    name, column = place
    path = write(tmp_path_factory.mktemp("d4rl") / "a.hdf5")
    with h5py.File(path, "a") as file:
        file[name][row if column is None else (row, column)] = bad
    with pytest.raises(DataError) as caught:
        read_d4rl(path)
    assert caught.value.source == str(path)
    assert caught.value.column == (name if column is None else f"{name}[{column}]")
    assert caught.value.row == row + 1


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_cut_off_file_is_refused(tmp_path, share):
    path = write(tmp_path / "a.hdf5")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=r"a.hdf5: .*(truncated|empty)"):
        load(path)


def test_text_with_an_hdf5_name_is_refused(tmp_path):
    path = tmp_path / "a.hdf5"
    path.write_text("1 2 3")
    with pytest.raises(DataError, match="cannot be read as HDF5"):
        load(path)
