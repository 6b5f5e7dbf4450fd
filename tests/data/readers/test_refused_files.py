"""Files whose values are elsewhere, nowhere or too many, fifos, and layouts that expand without measure."""

import json
import os
import threading

import h5py
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.data.recordings import make_arrays, make_recording
from torchrl_h2o.data import DataError, LogColumns, load, read_d4rl, read_minari, write_minari, write_ted
from torchrl_h2o.data.readers.memory_map import load_memory_map

LENGTHS, ENDINGS = (4, 1, 3), (True, False, False)


@pytest.fixture
def minari(tmp_path):
    """A Minari dataset's folder and its open main file."""
    folder = write_minari(make_recording(LENGTHS, ENDINGS), "test-v0", root=tmp_path)
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        yield folder, file


@pytest.fixture
def d4rl(tmp_path):
    """A D4RL file's path and the open file."""
    made = make_arrays(LENGTHS, ENDINGS)
    names = {"observations": "observation", "next_observations": "next_observation", "actions": "action"}
    names |= {"rewards": "reward", "terminals": "terminated", "timeouts": "truncated"}
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for name, key in names.items():
            file[name] = made[key]
        yield tmp_path / "a.hdf5", file


def put(file, name, values):
    del file[name]
    file[name] = values


def refused(reader, source, file):
    """Returns the error of reading; it is one line with a short cause and a remedy."""
    file.close()
    with pytest.raises(DataError) as caught:
        reader(source)
    text = str(caught.value)
    assert "\n" not in text
    assert "; " in text
    return caught.value


@pytest.mark.parametrize("flag", [2, 0.5, -1, np.nan])
@pytest.mark.parametrize("name", ["terminations", "truncations"])
def test_minari_flag_other_than_zero_and_one_is_refused(minari, name, flag):
    folder, file = minari
    put(file, f"episode_2/{name}", np.array([0, flag, 1], np.float64))
    error = refused(read_minari, folder, file)
    assert (error.column, error.row) == (f"episode_2/{name}", 2)
    assert f"the flag is {float(flag)}" in str(error)


def test_minari_flags_of_numbers_are_read(minari):
    folder, file = minari
    put(file, "episode_0/terminations", np.array([0, 0, 0, 1], np.int64))
    file.close()
    assert read_minari(folder)["next", "terminated"].flatten()[:4].tolist() == [False, False, False, True]


def test_d4rl_flag_that_is_not_a_number_is_refused(d4rl):
    path, file = d4rl
    put(file, "timeouts", np.full(8, np.nan))
    error = refused(read_d4rl, path, file)
    assert (error.column, error.row) == ("timeouts", 1)


@pytest.mark.parametrize("name", ["observations", "actions", "rewards"])
def test_complex_numbers_are_refused(minari, d4rl, name):
    folder, file = minari
    put(file, f"episode_0/{name}", file[f"episode_0/{name}"][:].astype(np.complex128))
    assert "complex128, expected real numbers" in str(refused(read_minari, folder, file))
    path, file = d4rl
    put(file, name, file[name][:].astype(np.complex64))
    assert "complex64, expected real numbers" in str(refused(read_d4rl, path, file))


@pytest.mark.parametrize("key", ["observation", "action", ("next", "reward")])
def test_complex_numbers_in_a_memory_map_are_refused(tmp_path, key):
    td = make_recording()
    td[key] = td[key].to(torch.complex64)
    with pytest.raises(DataError, match="complex64; "):
        write_ted(td, tmp_path / "checked")
    TensorDict.memmap(td, str(tmp_path / "ted"))
    with pytest.raises(DataError, match="complex64; "):
        load(tmp_path / "ted")


def external_link(file, name, folder):
    values = file[name][:]
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["values"] = values
    put(file, name, h5py.ExternalLink(str(folder / "other.hdf5"), "values"))


def soft_link(file, name, folder):
    file["elsewhere"] = file[name][:]
    put(file, name, h5py.SoftLink("/elsewhere"))


def raw_storage(file, name, folder):
    values = file[name][:]
    (folder / "raw.bin").write_bytes(values.tobytes())
    del file[name]
    external = [(str(folder / "raw.bin"), 0, values.nbytes)]
    file.create_dataset(name, values.shape, values.dtype, external=external)


def virtual(file, name, folder, *, source="other.hdf5", inner="values"):
    values = file[name][:]
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource(source, inner, values.shape, values.dtype)
    del file[name]
    file.create_virtual_dataset(name, layout)


def virtual_in_another_file(file, name, folder):
    with h5py.File(folder / "other.hdf5", "w") as other:
        other["values"] = file[name][:]
    virtual(file, name, folder, source=str(folder / "other.hdf5"))


def virtual_without_array(file, name, folder):
    virtual(file, name, folder, source=".", inner="absent")


def unwritten(file, name, folder):
    shape, dtype = file[name].shape, file[name].dtype
    del file[name]
    file.create_dataset(name, (10**9, *shape[1:]), dtype, chunks=(1024, *shape[1:]), compression="gzip")


ELSEWHERE = [
    (external_link, "it is a link to the file .*other.hdf5"),
    (soft_link, "it is a link to /elsewhere"),
    (raw_storage, "its values are in the file .*raw.bin"),
    (virtual, "its values are in the file other.hdf5, which is missing"),
    (virtual_in_another_file, r"its values are in the file .*other.hdf5; "),
    (virtual_without_array, "its values are in the array absent, which is missing"),
    (unwritten, r"it states \d{9,} bytes \[1000000000.*, but the file stores \d+ bytes of it"),
]


@pytest.mark.parametrize(("change", "message"), ELSEWHERE)
@pytest.mark.parametrize("name", ["observations", "rewards"])
def test_values_that_are_not_in_the_file_are_refused(minari, d4rl, tmp_path, change, message, name):
    path, file = d4rl
    change(file, name, tmp_path)
    error = refused(read_d4rl, path, file)
    assert error.column == name
    folder, file = minari
    change(file, f"episode_1/{name}", tmp_path)
    inner = refused(read_minari, folder, file)
    assert inner.column == f"episode_1/{name}"
    for found in (error, inner):
        with pytest.raises(DataError, match=message):
            raise found


def test_a_group_of_another_file_is_refused(minari, tmp_path):
    folder, file = minari
    with h5py.File(tmp_path / "other.hdf5", "w") as other:
        file.copy("episode_2", other)
    put(file, "episode_2", h5py.ExternalLink(str(tmp_path / "other.hdf5"), "episode_2"))
    assert refused(read_minari, folder, file).column == "episode_2"


def test_virtual_and_compressed_arrays_of_the_file_itself_are_read(d4rl):
    path, file = d4rl
    observations = file["observations"][:]
    file["elsewhere"] = observations
    virtual(file, "observations", path.parent, source=".", inner="elsewhere")
    del file["rewards"]
    file.create_dataset("rewards", data=np.zeros(8), compression="gzip")
    file.close()
    assert torch.equal(read_d4rl(path)["observation"], torch.from_numpy(observations))


def test_groups_linked_in_a_circle_are_refused(minari):
    folder, file = minari
    file["episode_0/infos/again"] = file["episode_0"]
    error = refused(read_minari, folder, file)
    assert "another link to episode_0" in str(error)


def test_metadata_that_state_more_episodes_than_the_file_has_bytes_are_refused(minari):
    folder, file = minari
    path = folder / "data" / "metadata.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "total_episodes": 10**10}))
    assert "states 10000000000 episodes" in str(refused(read_minari, folder, file))


def test_a_memory_map_that_states_a_shape_beyond_all_numbers_is_refused(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "ted")
    meta = json.loads((folder / "meta.json").read_text())
    meta["action"]["shape"] = [2**62, 4]  # the product is 0 in 64 bits
    (folder / "meta.json").write_text(json.dumps(meta))
    (folder / "action.memmap").write_bytes(b"")
    with pytest.raises(DataError, match=f"has 0 bytes, but meta.json states {2**66}"):
        load_memory_map(folder)


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LAUGHS, "row .*the aliases expand to too many entries"),
        (f"{LAUGHS}columns: *a11\n", "the aliases expand to too many entries"),
        ("columns: &a [*a]\n", "an anchor contains itself"),
        ("columns: &a\n  - {name: *a, role: observation}\n", "an anchor contains itself"),
        ("columns: " + "[" * 600 + "]" * 600, "nested too deeply"),
        ("# " + "x" * 2**20 + "\ncolumns: []\n", "the file has 1048591 bytes"),
    ],
)
def test_layouts_that_expand_without_measure_are_refused(tmp_path, text, message):
    (tmp_path / "log.yaml").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        LogColumns.load(tmp_path / "log.yaml")
    assert len(str(caught.value)) < 600


def test_an_alias_in_a_layout_is_read(tmp_path):
    text = "dt: 0.1\ncolumns:\n  - {name: q, role: observation, unit: &u rad}\n  - {name: u, role: action, unit: *u}\n"
    (tmp_path / "log.yaml").write_text(text)
    assert [column.unit for column in LogColumns.load(tmp_path / "log.yaml").columns] == ["rad", "rad"]


def in_time(call):
    """Returns the DataError of a call that must not wait; a waiting call is left behind in its thread."""
    errors = []

    def run():
        try:
            call()
        except DataError as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(20)
    assert not thread.is_alive(), "the reader waits for the fifo"
    return errors[0]


@pytest.mark.parametrize("name", ["log.csv", "log.txt", "a.hdf5", "log.npz", "log.parquet", "log.mat", "log.mcap"])
def test_a_fifo_is_refused_and_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    assert "not a regular file" in str(in_time(lambda: load(tmp_path / name, columns="simple_pendulum")))


def test_a_fifo_in_a_data_set_is_refused(minari):
    folder, file = minari
    file.close()
    for name in ("main_data.hdf5", "metadata.json"):
        (folder / "data" / name).unlink()
        os.mkfifo(folder / "data" / name)
        assert in_time(lambda: read_minari(folder))


def test_a_fifo_as_a_layout_is_refused(tmp_path):
    os.mkfifo(tmp_path / "log.yaml")
    assert "not a regular file" in str(in_time(lambda: LogColumns.load(tmp_path / "log.yaml")))


def test_a_fifo_in_a_memory_map_is_refused(tmp_path):
    folder = write_ted(make_recording(), tmp_path / "ted")
    (folder / "action.memmap").unlink()
    os.mkfifo(folder / "action.memmap")
    assert in_time(lambda: load(folder))


@pytest.mark.parametrize(
    ("entry", "value", "said"),
    [
        ("is_nested", True, "nested tensor"),
        ("shape", [[8], 3], "cannot be read"),
        ("shape", [8, 3.0], "cannot be read"),
    ],
)
def test_a_memory_map_with_another_kind_of_entry_is_refused(tmp_path, entry, value, said):
    folder = write_ted(make_recording(), tmp_path / "ted")
    meta = json.loads((folder / "meta.json").read_text())
    meta["observation"][entry] = value
    (folder / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(DataError, match=said):
        load(folder)


@pytest.mark.parametrize(("entry", "value"), [("total_steps", [8]), ("total_steps", "many"), ("dataset_id", "")])
def test_a_minari_dataset_with_an_entry_of_a_wrong_kind_is_refused(tmp_path, entry, value):
    folder = write_minari(make_recording(LENGTHS, ENDINGS), "test-v0", root=tmp_path)
    path = folder / "data" / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {entry: value}))
    with pytest.raises(DataError, match="no Minari dataset can be opened"):
        read_minari(folder)


def test_a_damaged_directory_of_an_npz_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, t=np.zeros(4), u=np.zeros(4))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"PK\x01\x02", b"PK\x01\x00", 1))
    with pytest.raises(DataError, match="cannot be read as"):
        load(path, columns="simple_pendulum")


def test_causes_are_one_short_line():
    error = DataError("a\n" + 500 * "b" + "\nend", "do this", source="log.csv")
    assert str(error).startswith("log.csv: a bbb")
    assert str(error).endswith("bb end; do this")
    assert len(str(error)) == len("log.csv") + 300
    named = str(DataError("wrong", 200 * "correct it ", source="log.csv", column=1000 * "c\x1b"))
    assert named.isprintable()
    assert len(named) <= len("log.csv") + 300
