"""Reading and writing Minari datasets, compared with h5py and minari."""

import hashlib
import json
import tempfile

import gymnasium
import h5py
import minari
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from torchrl.envs import GymEnv

from tests.data.recordings import assert_same, make_recording, recordings
from torchrl_h2o.data import DataError, check_specs, episodes, load, read_minari, write_minari


@settings(max_examples=6, deadline=None)
@given(recordings())
def test_episodes_survive_minari(td):
    with tempfile.TemporaryDirectory() as root:
        read = read_minari(write_minari(td, "made_up/test-v0", root=root))
    assert_same(read, td)
    assert [len(episode) for episode in episodes(read)] == [len(e) for e in episodes(td)]


def test_values_equal_those_in_the_file(shared_data):
    folder = shared_data / "minari" / "halfcheetah" / "medium-replay-v0"
    td = read_minari(folder)
    lengths = [len(episode) for episode in episodes(td)]
    starts = np.cumsum([0, *lengths])
    assert starts[-1] == len(td)
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        assert len(lengths) == len(file)
        for number in range(0, len(file), 20):
            group, episode = file[f"episode_{number}"], td[starts[number] : starts[number + 1]]
            observations = torch.from_numpy(group["observations"][:])
            assert torch.equal(episode["observation"], observations[:-1])
            assert torch.equal(episode["next", "observation"], observations[1:])
            assert torch.equal(episode["action"], torch.from_numpy(group["actions"][:]))
            assert torch.equal(episode["next", "reward"].flatten(), torch.from_numpy(group["rewards"][:]).float())
            assert torch.equal(episode["next", "terminated"].flatten(), torch.from_numpy(group["terminations"][:]))
    assert td["observation"].abs().mean() > 0.1


def test_name_is_looked_up_in_the_datasets_path(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    write_minari(make_recording(observations=17, actions=6), "halfcheetah/made-v0")
    td = load("halfcheetah/made-v0", env=GymEnv("HalfCheetah-v5"))
    assert len(td) == 8
    with pytest.raises(DataError, match=r"\[17\] dimensions, the environment has \[11\]"):
        check_specs(td, GymEnv("Hopper-v5"))


def test_reading_leaves_the_source_untouched(tmp_path):
    folder = write_minari(make_recording(), "test-v0", root=tmp_path)

    def state():
        return {path: hashlib.sha256(path.read_bytes()).digest() for path in tmp_path.rglob("*") if path.is_file()}

    before = state()
    read_minari(folder)
    read_minari(folder / "data")
    assert state() == before


def test_name_that_is_not_local_is_downloaded(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def download(dataset_id):
        write_minari(make_recording(), dataset_id, root=tmp_path)

    monkeypatch.setattr(minari.storage.hosting, "download_dataset", download)
    assert_same(load("far/away-v3"), make_recording())


def test_name_that_nobody_has_is_a_data_error(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def download(dataset_id):
        raise ConnectionError("no network")

    monkeypatch.setattr(minari.storage.hosting, "download_dataset", download)
    with pytest.raises(DataError, match=r"far/away-v3.*no network.*MINARI_DATASETS_PATH"):
        load("far/away-v3")


def test_minari_itself_reads_what_was_written(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    recorded = GymEnv("Pendulum-v1").rollout(200)
    write_minari(
        recorded,
        "pendulum/random-v0",
        env=GymEnv("Pendulum-v1"),
        env_spec=gymnasium.spec("Pendulum-v1"),
        author="somebody",
        description="random torques",
    )
    assert list(minari.list_local_datasets()) == ["pendulum/random-v0"]
    dataset = minari.load_dataset("pendulum/random-v0")
    assert dataset.action_space == gymnasium.spaces.Box(-2, 2, (1,), np.float32)
    assert dataset.recover_environment().spec.id == "Pendulum-v1"
    assert dataset.storage.metadata["description"] == "random torques"
    (episode,) = dataset.iterate_episodes()
    assert len(episode.observations) == 201
    np.testing.assert_array_equal(episode.observations[-1], recorded["next", "observation"][-1])


def test_episodes_without_an_end_are_truncated(tmp_path):
    folder = write_minari(make_recording((3, 2), (False, False)), "test-v0", root=tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        for number in range(2):
            file[f"episode_{number}/truncations"][-1] = False
    read = read_minari(folder)
    assert read["next", "truncated"].flatten().tolist() == [False, False, True, False, True]
    assert_same(read, make_recording((3, 2), (False, False)))


def test_recording_that_stops_midway_is_written_as_truncated(tmp_path):
    td = make_recording((3,), (False,))
    td["next", "done"][-1] = td["next", "truncated"][-1] = False
    folder = write_minari(td, "test-v0", root=tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        assert file["episode_0/truncations"][:].tolist() == [False, False, True]


def test_jump_inside_an_episode_is_not_written(tmp_path):
    td = make_recording()
    td["observation"][2] += 1
    with pytest.raises(DataError, match="not the next observation") as caught:
        write_minari(td, "test-v0", root=tmp_path)
    assert caught.value.row == 3
    assert not list(tmp_path.iterdir())


def test_action_outside_the_environment_is_not_written(tmp_path):
    recorded = GymEnv("Pendulum-v1").rollout(5)
    recorded["action"][3] = 2.5
    with pytest.raises(DataError, match=r"2.5 lies outside .*\[-2.0, 2.0\]"):
        write_minari(recorded, "test-v0", root=tmp_path, env=GymEnv("Pendulum-v1"))


def test_recording_without_reward_is_not_written(tmp_path):
    with pytest.raises(DataError, match=r"next.reward.*missing"):
        write_minari(make_recording().exclude(("next", "reward")), "test-v0", root=tmp_path)


@pytest.mark.parametrize("name", ["no-version", "bad name-v0"])
def test_name_that_minari_would_not_take_is_refused(tmp_path, name):
    with pytest.raises(DataError, match="not a valid Minari name"):
        write_minari(make_recording(), name, root=tmp_path)


def test_existing_dataset_is_not_overwritten(tmp_path):
    write_minari(make_recording(), "test-v0", root=tmp_path)
    with pytest.raises(DataError, match="never overwritten"):
        write_minari(make_recording(), "test-v0", root=tmp_path)


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_cut_off_file_is_refused(tmp_path, share):
    folder = write_minari(make_recording((50,) * 9, (True,) * 9), "test-v0", root=tmp_path)
    file = folder / "data" / "main_data.hdf5"
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=r"cannot be read.*truncated"):
        read_minari(folder)


def test_missing_episode_is_refused(tmp_path):
    folder = write_minari(make_recording(), "test-v0", root=tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        del file["episode_2"]
    with pytest.raises(DataError, match="episode 2 cannot be read"):
        read_minari(folder)


def test_metadata_that_promise_more_are_refused(tmp_path):
    folder = write_minari(make_recording(), "test-v0", root=tmp_path)
    file = folder / "data" / "metadata.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "total_steps": 9}))
    with pytest.raises(DataError, match="state 9 steps, the file contains 8"):
        read_minari(folder)


def test_episode_whose_parts_do_not_fit_is_refused(tmp_path):
    folder = write_minari(make_recording(), "test-v0", root=tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        actions = file["episode_0/actions"][:3]
        del file["episode_0/actions"]
        file["episode_0/actions"] = actions
    with pytest.raises(DataError, match=r"episode_0/actions.*\[3, 2\], expected \[4, 2\]"):
        read_minari(folder)


def test_value_that_is_not_finite_is_named(tmp_path):
    folder = write_minari(make_recording(), "test-v0", root=tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        file["episode_2/observations"][3, 1] = np.nan
    with pytest.raises(DataError, match="nan") as caught:
        read_minari(folder)
    assert (caught.value.column, caught.value.row) == ("episode_2/observations[1]", 4)


def test_folder_without_a_dataset_is_refused(tmp_path):
    (tmp_path / "data").mkdir()
    with pytest.raises(DataError, match="no Minari dataset"):
        read_minari(tmp_path)


def test_data_of_another_task_are_refused_and_of_another_version_are_not(tmp_path):
    env = GymEnv("Pendulum-v1")
    folder = write_minari(env.rollout(5), "pendulum/random-v0", root=tmp_path, env_spec=gymnasium.spec("Pendulum-v1"))
    assert len(load(folder, task="Pendulum-v0")) == 5
    with pytest.raises(DataError, match=r"recorded in Pendulum-v1, not in HalfCheetah-v5"):
        load(folder, task="HalfCheetah-v5")


def test_a_relative_root_is_the_folder_that_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = write_minari(make_recording(), "test-v0", root="sets")
    assert folder == tmp_path / "sets" / "test-v0"
    assert_same(read_minari(folder), make_recording())
    assert [path.name for path in tmp_path.iterdir()] == ["sets"]
