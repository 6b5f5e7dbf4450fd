"""TED, its memory map, and files that are rejected before they are opened."""

import pickle
import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import NonTensorData, TensorDict
from torchrl.envs import GymEnv

from tests.data.recordings import assert_same, make_recording, recordings
from torchrl_h2o.data import DataError, episodes, read_ted, write_ted
from torchrl_h2o.data.readers.ted import require_continuous, require_ted


def test_entries_have_ted_names_shapes_and_dtypes():
    td = make_recording()
    assert td.batch_size == (8,)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert td[key].dtype == torch.float32
    for flag in ("done", "terminated", "truncated"):
        assert td[flag].shape == td["next", flag].shape == (8, 1)
        assert td["next", flag].dtype == torch.bool
        assert not td[flag].any()
    assert td["next", "reward"].shape == (8, 1)


@settings(max_examples=7, deadline=None)
@given(recordings())
def test_episodes_survive_a_memory_map(td):
    with tempfile.TemporaryDirectory() as folder:
        read = read_ted(write_ted(td, Path(folder) / "recording"))
    assert_same(read, td)
    assert [len(episode) for episode in episodes(read)] == [len(e) for e in episodes(td)]


def test_episode_cut_by_the_end_of_the_data_is_truncated(tmp_path):
    td = make_recording()
    td["next", "done"][-1] = td["next", "truncated"][-1] = False
    read = read_ted(write_ted(td, tmp_path / "cut"))
    assert read["next", "truncated"][-1]
    assert read["next", "done"][-1]
    assert not read["next", "terminated"][-1]


def test_truncated_is_added_where_an_environment_has_none(tmp_path):
    td = make_recording().exclude(("next", "truncated"), "truncated")
    read = read_ted(write_ted(td, tmp_path / "bare"))
    assert_same(read.select(("next", "truncated")), make_recording().select(("next", "truncated")))


def test_writing_to_what_was_read_leaves_the_files_alone(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "recording")
    read_ted(folder)["observation"].zero_()
    assert_same(read_ted(folder), make_recording())


def test_mapped_data_are_read_without_a_copy(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "recording")
    td = read_ted(folder, in_memory=False)
    assert_same(td, make_recording())
    assert "MemoryMapped" in type(td["observation"]).__name__


def test_cut_off_file_is_refused_and_not_grown(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "recording")
    file = folder / "next" / "observation.memmap"
    file.write_bytes(file.read_bytes()[:20])
    with pytest.raises(DataError, match=r"observation.memmap.*has 20 bytes.*states 96.*truncated"):
        read_ted(folder)
    assert file.stat().st_size == 20


def test_missing_file_is_refused(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "recording")
    (folder / "next" / "reward.memmap").unlink()
    with pytest.raises(DataError, match=r"reward.memmap.*0 bytes"):
        read_ted(folder)


@pytest.mark.parametrize("text", ["", "[]", '{"observation": {"dtype": "torch.os", "shape": [1]}}'])
def test_broken_description_is_refused(tmp_path, text):
    folder = write_ted(make_recording(), tmp_path / "recording")
    (folder / "meta.json").write_text(text)
    with pytest.raises(DataError, match=r"meta.json|unreadable|missing"):
        read_ted(folder)


class _Bomb:
    def __reduce__(self):
        return (Path.touch, (Path("unpickled"),))


def test_memory_map_with_a_pickle_in_it_is_never_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    td = make_recording()
    td["extra"] = NonTensorData(_Bomb())
    td.memmap(tmp_path / "recording")
    assert list((tmp_path / "recording").rglob("*.pickle"))
    with pytest.raises(DataError, match="pickle"):
        read_ted(tmp_path / "recording")
    assert not (tmp_path / "unpickled").exists()


def test_hidden_pickle_is_found_by_its_content(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "recording")
    (folder / "notes.json").write_bytes(pickle.dumps(1))
    with pytest.raises(DataError, match=r"notes.json.*pickle"):
        read_ted(folder)


def test_object_is_not_written(tmp_path):
    td = make_recording()
    td["extra"] = NonTensorData(_Bomb())
    with pytest.raises(DataError, match=r"'extra'.*not a tensor"):
        write_ted(td, tmp_path / "recording")
    assert not list(tmp_path.iterdir())


def test_existing_folder_is_not_overwritten(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "recording")
    with pytest.raises(DataError, match="never overwritten"):
        write_ted(make_recording(seed=1), folder)
    assert_same(read_ted(folder), make_recording())


def test_a_place_where_no_folder_can_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"file/recording: the folder cannot be made: Not a directory; choose another"):
        write_ted(make_recording(), tmp_path / "file" / "recording")


def test_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(TensorDict, "memmap", fail)
    with pytest.raises(OSError, match="disk full"):
        write_ted(make_recording(), tmp_path / "recording")
    assert not list(tmp_path.iterdir())


@settings(max_examples=10, deadline=None)
@given(
    row=st.integers(0, 7),
    column=st.integers(0, 1),
    key=st.sampled_from(["observation", "action", ("next", "observation")]),
    bad=st.sampled_from([float("nan"), float("inf"), -float("inf")]),
)
def test_any_value_that_is_not_finite_is_named(row, column, key, bad):
    td = make_recording()
    td[key][row, column] = bad
    with pytest.raises(DataError, match=r"nan|inf") as caught:
        require_ted(td, source="here")
    name = key if isinstance(key, str) else ".".join(key)
    assert (caught.value.row, caught.value.column) == (row + 1, f"{name}[{column}]")


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation"), ("next", "done")])
def test_missing_entry_is_named(key):
    with pytest.raises(DataError, match="missing") as caught:
        require_ted(make_recording().exclude(key))
    assert caught.value.column == (key if isinstance(key, str) else ".".join(key))


def test_batch_of_episodes_is_refused_as_it_is():
    with pytest.raises(DataError, match=r"\[2, 4\], expected \[T\]"):
        require_ted(make_recording().reshape(2, 4))


def test_reward_of_the_wrong_shape_is_refused():
    td = make_recording()
    td["next", "reward"] = td["next", "reward"].squeeze(-1)
    with pytest.raises(DataError, match=r"'next.reward'.*\[8\], expected \[8, 1\]"):
        require_ted(td)


@pytest.fixture
def float64_folder(tmp_path):
    """Returns the folder of a float64 recording from a MuJoCo simulator."""
    recorded = GymEnv("InvertedPendulum-v5").rollout(5)
    assert recorded["observation"].dtype == torch.float64
    return write_ted(recorded, tmp_path / "float64")


def test_float64_recording_is_read_as_float32(float64_folder):
    td = read_ted(float64_folder)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        assert td[key].dtype == torch.float32
    mapped = TensorDict.load_memmap(float64_folder)
    assert torch.equal(td["observation"], mapped["observation"].float())


def test_float64_recording_is_not_mapped(float64_folder):
    with pytest.raises(DataError, match=r"'observation'.*float64.*in_memory=True"):
        read_ted(float64_folder, in_memory=False)


def test_integer_actions_stay_integers_and_integer_observations_are_refused(tmp_path):
    td = make_recording()
    td["action"] = td["action"].long()
    assert read_ted(write_ted(td, tmp_path / "discrete"))["action"].dtype == torch.int64
    td["observation"] = td["observation"].long()
    with pytest.raises(DataError, match=r"'observation'.*int64.*real numbers"):
        write_ted(td, tmp_path / "integers")


@pytest.mark.parametrize("key", ["truncated", ("next", "done"), ("next", "terminated")], ids=str)
def test_flags_other_than_bool_are_refused(key):
    td = make_recording()
    td[key] = td[key].float()
    with pytest.raises(DataError, match=r"float32, expected torch.bool"):
        require_ted(td)


@pytest.mark.parametrize("flag", ["terminated", "truncated"])
def test_end_without_done_is_named_by_its_row(flag):
    td = make_recording()
    td["next", flag][5] = True
    with pytest.raises(DataError, match=f"{flag} is true but done is false") as caught:
        require_ted(td)
    assert (caught.value.column, caught.value.row) == ("next.done", 6)


@pytest.mark.parametrize("key", ["observation", "action"])
@pytest.mark.parametrize("shape", [(8,), (8, 2, 1)], ids=str)
def test_entry_that_is_no_vector_a_step_is_refused(key, shape):
    td = make_recording()
    td[key] = torch.zeros(shape)
    with pytest.raises(DataError, match=r"expected \[8, n\]") as caught:
        require_ted(td)
    assert caught.value.column == key


@settings(max_examples=7, deadline=None)
@given(recordings())
def test_whole_episodes_are_continuous(td):
    require_continuous(td)


@pytest.mark.parametrize("row", [1, 3, 6])
def test_row_that_begins_elsewhere_is_named(row):
    td = make_recording()  # episodes begin at rows 0, 4 and 5
    td["observation"][row, 1] += 1e-3
    with pytest.raises(DataError, match="not the next observation") as caught:
        require_continuous(td, source="here")
    assert (caught.value.source, caught.value.column, caught.value.row) == ("here", "observation", row + 1)


def test_killed_writer_is_no_obstacle(tmp_path):
    """A partial folder left by a killed process does not prevent the next write."""
    left = tmp_path / f".recording.{'0a' * 16}.partial"
    left.mkdir()
    (left / "junk").write_text("junk")
    folder = write_ted(make_recording(), tmp_path / "recording")
    assert not (folder / "junk").exists()
    assert_same(read_ted(folder), make_recording())
    shutil.rmtree(folder)
