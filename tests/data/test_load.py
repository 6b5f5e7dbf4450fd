"""load(): all kinds of sources, and errors for invalid ones."""

import io
import pickle
import zipfile

import h5py
import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv

from tests.data.recordings import assert_same, make_recording
from torchrl_h2o.data import DataError, check_specs, load, write_minari, write_ted


def test_each_source_finds_its_reader(tmp_path):
    td = make_recording()
    assert_same(load(write_ted(td, tmp_path / "ted")), td)
    assert_same(load(write_minari(td, "test-v0", root=tmp_path)), td)
    assert_same(load(str(tmp_path / "test-v0" / "data")), td)
    (tmp_path / "log.txt").write_text("0 0 0 0 1 0\n" * 3)
    read = load(tmp_path / "log.txt", columns="wheel_legged_moving_forward")
    assert read["observation"].shape == (2, 3)


def test_task_that_cannot_be_checked_is_warned_of(tmp_path, log_messages):
    td = make_recording()
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for name in ("observations", "actions"):
            file[name] = np.zeros((4, 2))
        for name in ("rewards", "terminals", "timeouts"):
            file[name] = np.zeros(4)
    sources = [tmp_path / "a.hdf5", write_ted(td, tmp_path / "ted"), write_minari(td, "test-v0", root=tmp_path)]
    for source in sources:
        log_messages.clear()
        load(source)
        assert not any("does not name the task" in message for message in log_messages)
        load(source, task="HalfCheetah-v5")
        (warning,) = (message for message in log_messages if "does not name the task" in message)
        assert (
            warning
            == f"{source} does not name the task it was recorded in; whether it is HalfCheetah-v5 was not checked"
        )


def test_columns_for_what_is_no_log_are_refused(tmp_path):
    td = make_recording()
    (tmp_path / "a.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n")
    sources = [tmp_path / "a.hdf5", write_ted(td, tmp_path / "ted"), write_minari(td, "test-v0", root=tmp_path)]
    for source in [*sources, "halfcheetah/medium-v0"]:
        with pytest.raises(DataError, match="columns were given, but the source is not a log") as caught:
            load(source, columns="simple_pendulum")
        assert caught.value.source == str(source)


def test_log_without_columns_says_what_is_missing(tmp_path):
    (tmp_path / "log.txt").write_text("0 0 0\n" * 3)
    with pytest.raises(DataError, match=r"log.txt.*give columns="):
        load(tmp_path / "log.txt")


@pytest.mark.parametrize("source", ["no/such/file.csv", "./halfcheetah-v0", "~nobody/x", "plain"])
def test_missing_file_is_not_looked_for_on_the_net(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="no such file"):
        load(source)


def test_folder_that_holds_nothing_known_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"neither a Minari dataset.*nor"):
        load(tmp_path)


def _zip():
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        file.writestr("data.pkl", b"\x80\x04N.")
    return content.getvalue()


def _objects():
    content = io.BytesIO()
    np.save(content, np.array([object], dtype=object), allow_pickle=True)
    return content.getvalue()


def _checkpoint():
    content = io.BytesIO()
    torch.save({"a": torch.zeros(1)}, content)
    return content.getvalue()


@pytest.mark.parametrize("name", ["data.csv", "data.hdf5", "data", "data.txt"])
@pytest.mark.parametrize(
    "content",
    [pickle.dumps([1], protocol) for protocol in (2, 3, 4, 5)] + [_zip(), _objects(), _checkpoint()],
)
def test_pickle_under_any_name_is_refused(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError, match=f"{name}: this is a pickle"):
        load(path, columns="simple_pendulum")


@pytest.mark.parametrize("suffix", ["pkl", "pickle", "npy", "npz", "joblib"])
def test_pickle_is_refused_by_its_name(tmp_path, suffix):
    path = tmp_path / f"data.{suffix}"
    path.write_bytes(pickle.dumps([1], 0))  # protocol 0 is plain text
    with pytest.raises(DataError, match="this is a pickle"):
        load(path, columns="simple_pendulum")


def test_data_are_checked_against_the_environment(tmp_path):
    folder = write_ted(make_recording(observations=3, actions=1), tmp_path / "ted")
    assert len(load(folder, env=GymEnv("Pendulum-v1"))) == 8
    with pytest.raises(DataError, match=r"ted, column 'observation'.*\[3\].*\[4\]"):
        load(folder, env=GymEnv("InvertedPendulum-v5"))


def test_wrong_action_dimensions_are_refused():
    with pytest.raises(DataError, match=r"'action'.*\[2\] dimensions, the environment has \[1\]"):
        check_specs(make_recording(observations=3, actions=2), GymEnv("Pendulum-v1"))


def test_integer_actions_do_not_fit_a_continuous_environment():
    td = make_recording(observations=3, actions=1)
    td["action"] = td["action"].long()
    with pytest.raises(DataError, match=r"int64, the environment uses torch.float32"):
        check_specs(td, GymEnv("Pendulum-v1"))


def test_actions_on_the_bound_and_rounded_are_inside():
    td = make_recording(observations=3, actions=1)
    td["action"][0], td["action"][1] = 2.0, -2.0000002
    check_specs(td, GymEnv("Pendulum-v1"))
    for row, action in ((5, -2.001), (4, 2.001)):
        td["action"][row] = action
        with pytest.raises(DataError, match="lies outside") as caught:
            check_specs(td, GymEnv("Pendulum-v1"))
        assert (caught.value.column, caught.value.row) == ("action[0]", row + 1)


def test_environment_without_an_observation_entry_is_refused():
    class Dictionary:
        def __init__(self, env):
            self.observation_spec_unbatched = env.full_action_spec_unbatched
            self.full_action_spec_unbatched = env.full_action_spec_unbatched

    with pytest.raises(DataError, match=r"no entry 'observation', it has \['action'\].*CatTensors"):
        check_specs(make_recording(), Dictionary(GymEnv("Pendulum-v1")))


@pytest.mark.parametrize("source", [None, 3, [None]])
def test_what_is_no_source_is_refused(source):
    with pytest.raises(DataError, match="is neither a path nor a list of paths"):
        load(source)


def test_tensors_of_torch_are_read_by_name(tmp_path):
    angle = torch.linspace(0.0, 1.0, 50)
    tensors = {"t": 0.01 * torch.arange(50.0), "q": torch.stack([angle, 2 * angle], 1), "servo": {"goal": angle.half()}}
    torch.save({**tensors, "gain": torch.tensor(3.0), "note": "hung up"}, tmp_path / "log.pt")
    columns = {
        "columns": [
            {"name": "t", "role": "time", "unit": "s"},
            {"name": "q[1]", "role": "observation"},
            {"name": "servo.goal", "role": "action"},
        ],
        "header": True,
        "other_columns": "ignore",
    }
    td = load(tmp_path / "log.pt", columns=columns)
    assert td["observation"][:, 0].tolist() == (2 * angle)[:-1].tolist()
    assert td["action"][:, 0].tolist() == angle.half()[:-1].tolist()


def test_tensors_that_are_no_numbers_of_the_file_are_refused(tmp_path):
    path = tmp_path / "log.pt"
    for values, said in (
        (torch.zeros(1).expand(4 * 10**8), "states 3200000000 bytes of values"),
        (torch.zeros(5, 5).to_sparse(), "tensors that are no plain numbers"),
    ):
        torch.save({"q": values}, path)
        with pytest.raises(DataError, match=said):
            load(path, columns="simple_pendulum")


@pytest.mark.parametrize("protocol", [0, 2])
def test_code_in_a_file_of_tensors_is_not_run(tmp_path, protocol):
    path, sign = tmp_path / "log.pt", tmp_path / "ran"

    class Harm:
        def __reduce__(self):
            return type(sign).touch, (sign,)

    for content in ({"q": torch.zeros(5), "x": Harm()}, [torch.zeros(5)], torch.zeros(5)):
        torch.save(content, path, pickle_protocol=2)
        with pytest.raises(DataError, match=r"log\.pt: it holds .*save the tensors by name: torch\.save"):
            load(path, columns="simple_pendulum")
    path.write_bytes(pickle.dumps(Harm(), protocol))
    with pytest.raises(DataError, match="it holds more than tensors by name"):
        load(path, columns="simple_pendulum")
    assert not sign.exists()
