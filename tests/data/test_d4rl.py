"""D4RL files, with and without next_observations."""

import shutil

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


def swings(path, lengths=(200, 150, 250), terminated=(1,), **changes):
    """Writes episodes that begin near rest, each ``next_observations`` being the following row, also across a reset."""
    rng = np.random.default_rng(0)
    time = 0.05 * np.arange(max(lengths) + 1)[:, None]
    swing = 3.0 * (1.0 - np.cos(time * [1.0, 1.3, 0.7])) * [1.0, 2.0, 0.5]  # returns to its start, but slowly
    starts = 0.01 * rng.normal(size=(len(lengths), 3))
    states = [start + swing[:length] for start, length in zip(starts, lengths, strict=True)]
    rows = np.concatenate([*states, starts[-1:] + swing[lengths[-1], None]])
    terminals = np.zeros(len(rows) - 1)
    terminals[[sum(lengths[: episode + 1]) - 1 for episode in terminated]] = 1.0
    arrays = {"observations": rows[:-1], "next_observations": rows[1:], "terminals": terminals, "timeouts": None}
    arrays |= {"actions": np.zeros((len(terminals), 1)), "rewards": np.arange(len(terminals))}
    return write(path, **{**arrays, **changes})


def test_rows_that_lead_to_the_start_of_another_episode_are_dropped_and_counted(tmp_path, log_messages):
    found = read_d4rl(swings(tmp_path / "a.hdf5"))
    assert found["next", "reward"].flatten().tolist() == np.delete(np.arange(600), [199, 349]).tolist()
    assert found["next", "truncated"].flatten().nonzero().flatten().tolist() == [198, 347, 597]
    assert not found["next", "terminated"].any()
    (message,) = log_messages
    assert message.endswith(
        "a.hdf5: 2 of 600 rows are dropped, 1 of them terminal, because their next observation is the start of "
        "another episode"
    )


def test_rows_of_a_file_with_timeouts_are_kept(tmp_path, log_messages):
    assert len(read_d4rl(swings(tmp_path / "a.hdf5", timeouts=np.zeros(600)))) == 600
    assert not log_messages


def test_a_large_step_to_elsewhere_is_kept(tmp_path):
    path = swings(tmp_path / "a.hdf5", lengths=(600,), terminated=())
    with h5py.File(path, "a") as file:
        file["observations"][300:] += 20.0
        file["next_observations"][299:] += 20.0
    assert len(read_d4rl(path)) == 600


@pytest.mark.parametrize(
    ("task", "resets"), [("halfcheetah", (999, 2998, 3998)), ("walker2d", (885, 1784, 2784, 3784))]
)
def test_resets_of_a_published_set_are_found(shared_data, tmp_path, task, resets):
    folder = shared_data / "off_dynamics"
    path = shutil.copy(folder / f"{task}_gravity_0.5_medium_expert.hdf5", tmp_path)
    with h5py.File(path, "a") as file:
        steps = np.arange(len(file["rewards"]))
        file["rewards"][...] = steps
    assert read_d4rl(path)["next", "reward"].flatten().tolist() == np.delete(steps, resets).tolist()


@pytest.mark.parametrize("quality", ["medium", "expert"])
@pytest.mark.parametrize("task", ["halfcheetah_kinematic", "walker2d_gravity_0.5", "walker2d_morph"])
def test_no_row_of_a_published_set_without_such_resets_is_dropped(shared_data, task, quality):
    assert len(read_d4rl(shared_data / "off_dynamics" / f"{task}_{quality}.hdf5")) == 5000


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
