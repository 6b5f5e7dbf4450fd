"""The same log in every format, and damaged or suspicious files of each."""

import io
import pickle
import struct
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import torch

from torchrl_h2o.data import Column, DataError, LogColumns, episodes, load, read_robot_log
from torchrl_h2o.data.readers import file_kind

ROWS = 40
T = 0.01 * np.arange(ROWS)
Q, V, U = np.sin(T), np.cos(T), np.linspace(-1, 1, ROWS)


def layout(*, names=("t", "q", "v", "u"), **options):
    roles = ("time", "observation", "observation", "action")
    units = ("s", "deg", "deg/s", "N·m")
    columns = tuple(Column(name, role, unit) for name, role, unit in zip(names, roles, units, strict=True))
    return LogColumns(columns, **({"header": True, "other_columns": "ignore", "separator": ","} | options))


def table(columns):
    return "\n".join(",".join(map(repr, map(float, row))) for row in np.stack(columns, 1)) + "\n"


def write_csv(path):
    path.write_text("t,q,v,u,mode\n" + table([T, Q, V, U, T]))
    return layout()


def write_txt(path):
    path.write_text(table([T, Q, V, U]).replace(",", " "))
    return layout(header=False, separator="whitespace", other_columns="error")


def write_npz(path):
    np.savez_compressed(path, t=T, x=np.stack([Q, V], 1), u=U[:, None], dt=0.01, name="run")
    return layout(names=("t", "x[0]", "x[1]", "u"))


def write_mat(path):
    from scipy.io import savemat

    savemat(path, {"t": T, "log": {"x": np.stack([Q, V]), "u": U[:, None]}, "note": "a run"}, do_compression=True)
    return layout(names=("t", "log.x[0]", "log.x[1]", "log.u"))


def write_mat73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        file["t"] = T[None]
        file["log/x"] = np.stack([Q, V])
        file["log/u"] = U[None]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(512))
    return layout(names=("t", "log.x[0]", "log.x[1]", "log.u"))


def write_parquet(path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parquet.write_table(pyarrow.table({"mode": ["run"] * ROWS, "t": T, "u": U, "q": Q, "v": V}), path)
    return layout()


JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
START = 1_700_000_000_000_000_000


def joint_state(time, names, **values):
    stamp = {"sec": (START + int(1e9 * time)) // 10**9, "nanosec": (START + int(1e9 * time)) % 10**9}
    arrays = {name: [float(value) for value in values.get(name, [])] for name in ("position", "velocity", "effort")}
    return {"header": {"stamp": stamp, "frame_id": ""}, "name": names, **arrays}


def write_bag(path, messages):
    """Writes (topic, time of recording in s, JointState or list of numbers)."""
    pytest.importorskip("mcap_ros2")
    from mcap_ros2.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        numbers = writer.register_msgdef("std_msgs/msg/Float64MultiArray", "float64[] data")
        for topic, time, message in messages:
            schema = joints if isinstance(message, dict) else numbers
            content = message if isinstance(message, dict) else {"data": message}
            writer.write_message(topic, schema, content, log_time=START + int(1e9 * time))
        writer.finish()


def write_mcap(path):
    # the knee and the order of the joints change from message to message
    def state(i):
        values = {"knee": (0, 0, 0), "hip": (Q[i], V[i], U[i])}
        names = list(values) if i % 2 else list(values)[::-1]
        position, velocity, effort = zip(*(values[name] for name in names), strict=True)
        return joint_state(T[i], names, position=position, velocity=velocity, effort=effort)

    write_bag(path, [("/joint_states", T[i] + 0.001, state(i)) for i in range(ROWS)])
    return layout(names=("time", "hip.position", "hip.velocity", "hip.effort"))


FORMATS = {
    "log.csv": write_csv,
    "log.txt": write_txt,
    "log.npz": write_npz,
    "log.mat": write_mat,
    "log73.mat": write_mat73,
    "log.parquet": write_parquet,
    "log.mcap": write_mcap,
}


@pytest.fixture(params=FORMATS)
def log(request, tmp_path):
    """A log in one of the formats, and its layout."""
    path = tmp_path / request.param
    return path, FORMATS[request.param](path)


def test_the_same_log_is_read_from_every_format(log):
    path, columns = log
    td = load(path, columns=columns)
    expected = torch.from_numpy(np.deg2rad(np.stack([Q, V], 1))).float()
    torch.testing.assert_close(td["observation"], expected[:-1])
    torch.testing.assert_close(td["next", "observation"], expected[1:])
    torch.testing.assert_close(td["action"].flatten(), torch.from_numpy(U[:-1]).float())
    torch.testing.assert_close(td["time"].flatten(), torch.from_numpy(T[:-1]))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_file_that_is_cut_off_is_refused(log, share):
    path, columns = log
    if path.suffix in (".csv", ".txt"):
        pytest.skip("a text that is cut between two lines is a shorter log")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError) as caught:
        load(path, columns=columns)
    assert caught.value.source == str(path)
    assert len(str(caught.value)) < 700
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["log.npz", "log.mat", "log.parquet", "log.mcap"])
def test_a_column_that_is_missing_or_not_described_is_named(tmp_path, name):
    columns = FORMATS[name](tmp_path / name)
    renamed = LogColumns(**{**vars(columns), "columns": (*columns.columns[:-1], Column("tau", "action")), "action": ()})
    with pytest.raises(DataError, match="the column is missing; the header is ") as caught:
        load(tmp_path / name, columns=renamed)
    assert caught.value.column == "tau"
    if name in ("log.parquet", "log.mcap"):
        with pytest.raises(DataError, match="the column is not described"):
            load(tmp_path / name, columns=LogColumns(**{**vars(columns), "other_columns": "error"}))


def test_values_that_are_no_numbers_are_refused(tmp_path):
    np.savez(tmp_path / "log.npz", t=T, q=Q.astype(str), v=V * 1j, u=U)
    for name, kind in (("q", "<U"), ("v", "complex128")):
        names = {"q": "v", "v": "q"}
        columns = LogColumns(
            (
                Column(name, "observation"),
                Column(names[name], "ignore"),
                Column("u", "action"),
                Column("t", "time", "s"),
            )
        )
        with pytest.raises(DataError, match=f"the values are {kind}.*, expected real numbers") as caught:
            read_robot_log(tmp_path / "log.npz", columns)
        assert caught.value.column == name


def test_missing_values_are_refused(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    q = [*Q[:5].tolist(), None, *Q[6:].tolist()]
    parquet.write_table(pyarrow.table({"t": T, "q": q, "v": V, "u": U}), tmp_path / "log.parquet")
    with pytest.raises(DataError, match="the value is nan") as caught:
        load(tmp_path / "log.parquet", columns=layout())
    assert (caught.value.column, caught.value.row) == ("q", 6)


def test_dates_become_seconds(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    dates = np.datetime64("2026-11-23T00:00:00", "us") + (1e6 * T).astype("timedelta64[us]")
    parquet.write_table(pyarrow.table({"t": dates, "q": Q, "v": V, "u": U}), tmp_path / "log.parquet")
    torch.testing.assert_close(
        load(tmp_path / "log.parquet", columns=layout())["time"].flatten(), torch.from_numpy(T[:-1])
    )


def objects():
    content = io.BytesIO()
    np.savez(content, q=np.array([print], dtype=object))
    return content.getvalue()


def torch_file():
    content = io.BytesIO()
    torch.save({"a": torch.zeros(1)}, content)
    return content.getvalue()


@pytest.mark.parametrize("content", [objects(), torch_file(), pickle.dumps([1]), b"PK\x03\x04"])
def test_a_pickle_as_an_npz_is_refused(tmp_path, content):
    (tmp_path / "log.npz").write_bytes(content)
    with pytest.raises(DataError, match="this is a pickle"):
        load(tmp_path / "log.npz", columns=layout())


def test_an_array_that_states_more_than_the_file_has_is_refused(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**11,)})
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("q.npy", header.getvalue() + bytes(80))
    with pytest.raises(DataError, match=r"it states 800000000000 bytes \[100000000000\], but the file stores 80"):
        load(tmp_path / "log.npz", columns=layout())


@pytest.mark.parametrize("name", ["log.npz", "log.mat", "log.parquet"])
def test_a_small_file_of_very_many_values_is_refused(tmp_path, monkeypatch, name):
    monkeypatch.setattr(file_kind, "UNSUSPICIOUS_BYTES", 2**16)
    zeros, path = np.zeros(200_000), tmp_path / name  # 1.6 MB in memory
    if name == "log.npz":
        np.savez_compressed(path, q=zeros)
    elif name == "log.mat":
        from scipy.io import savemat

        savemat(path, {"q": zeros}, do_compression=True)
    else:
        pyarrow = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(pyarrow.table({"q": zeros}), path)
    with pytest.raises(DataError, match=r"it states 160\d+ bytes of values, but the file has \d+"):
        load(path, columns=layout())


def test_commands_of_other_topics_hold_their_last_value(tmp_path):
    states = [
        ("/joint_states", T[i], joint_state(T[i], ["hip"], position=[Q[i]], velocity=[V[i]])) for i in range(ROWS)
    ]
    numbers = [("/controller/commands", T[i] + 0.004, [0.0, U[i]]) for i in range(4, ROWS, 2)]
    wanted = [("/wanted", T[i] + 0.004, joint_state(T[i], ["hip"], effort=[U[i]])) for i in range(4, ROWS, 2)]
    write_bag(tmp_path / "log.mcap", sorted([*states, *numbers, *wanted], key=lambda message: message[1]))
    for command in ("/controller/commands:data[1]", "/wanted:hip.effort"):
        columns = layout(names=("time", "hip.position", "hip.velocity", command), topic="/joint_states")
        td = load(tmp_path / "log.mcap", columns=columns)
        assert td["time"][0].item() == pytest.approx(T[5])  # no command was received before
        held = U[4:-1:2].repeat(2)[: len(td)]
        torch.testing.assert_close(td["action"].flatten(), torch.from_numpy(held).float())
    with pytest.raises(
        DataError, match="several topics have joint states; set topic: to one of /joint_states, /wanted"
    ):
        load(tmp_path / "log.mcap", columns=layout())
    with pytest.raises(DataError, match="there is no topic /joints of joint states"):
        load(tmp_path / "log.mcap", columns=layout(topic="/joints"))


def test_a_bag_without_joint_states_or_of_unequal_lengths_is_refused(tmp_path):
    write_bag(tmp_path / "log.mcap", [("/commands", 0.0, [1.0]), ("/commands", 0.1, [1.0])])
    with pytest.raises(DataError, match="the bag has no sensor_msgs/msg/JointState"):
        load(tmp_path / "log.mcap", columns=layout())
    write_bag(tmp_path / "log.mcap", [("/joint_states", 0.0, joint_state(0, ["hip", "knee"], position=[1.0]))])
    with pytest.raises(DataError, match="message 1 of /joint_states has 2 joints and 1 values of position"):
        load(tmp_path / "log.mcap", columns=layout())


def test_columns_are_given_by_index(tmp_path):
    (tmp_path / "log.txt").write_text(table([T, Q, U, U, V]))
    columns = (
        Column("v", "observation", index=4),
        Column("q", "observation", index=1),
        Column("u", "action", index=3),
    )
    options = {"dt": 0.01, "separator": ",", "observation": ("q", "v")}
    td = read_robot_log(tmp_path / "log.txt", LogColumns(columns, **options, other_columns="ignore"))
    torch.testing.assert_close(td["observation"], torch.from_numpy(np.stack([Q, V], 1)[:-1]).float())
    with pytest.raises(DataError, match="the columns 0, 2 are not described"):
        read_robot_log(tmp_path / "log.txt", LogColumns(columns, **options))
    beyond = (*columns, Column("w", "ignore", index=5))
    with pytest.raises(DataError, match="its index is 5, but the file has 5 columns") as caught:
        read_robot_log(tmp_path / "log.txt", LogColumns(beyond, **options, other_columns="ignore"))
    assert caught.value.column == "w"
    (tmp_path / "head.csv").write_text("time (s),q,q,q,q\n" + table([T, Q, U, U, V]))  # ambiguous names do not matter
    named = LogColumns(columns, **options, other_columns="ignore", header=True)
    assert torch.equal(read_robot_log(tmp_path / "head.csv", named)["observation"], td["observation"])


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ((Column("q", "observation", index=0), Column("u", "action")), "give all or none an index"),
        ((Column("q", "observation", index=0), Column("u", "action", index=0)), "two columns have the same index"),
        ((Column("q", "observation"),), "no column with the role 'action'; set free_motion: true"),
        (
            (Column("q", "observation"), Column("v", "observation", derivative_of="p"), Column("u", "action")),
            "'p' must be",
        ),
    ],
)
def test_contradicting_columns_are_refused(columns, message):
    with pytest.raises(ValueError, match=message):
        LogColumns(columns, dt=0.01)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"index": -1}, "index -1 must be"),
        ({"index": True}, "index True must be"),
        ({"index": "1"}, "index '1' must be"),
        ({"derivative_of": "q", "unit": "rad/s"}, "is not in the file: omit index, unit, scale, offset, unwrap"),
        ({"derivative_of": "q", "role": "action"}, "derivative_of is for observations only"),
        ({"derivative_of": "q", "offset": 1.0}, "is not in the file"),
        ({"offset": float("nan")}, "offset nan must be finite"),
        ({"unwrap": True, "unit": "m"}, "unwrap is for observed or commanded angles"),
        ({"unwrap": True, "unit": "rad", "role": "ignore"}, "unwrap is for observed or commanded angles"),
        ({"unwrap": -1, "unit": "rad"}, "unwrap -1 must be true, false, or the size of a turn"),
        ({"unwrap": "yes", "unit": "rad"}, "unwrap 'yes' must be true, false, or the size of a turn"),
    ],
)
def test_invalid_columns_are_refused(entries, message):
    with pytest.raises(ValueError, match=message):
        Column(**({"name": "v", "role": "observation"} | entries))


def test_free_motion_has_no_actions(tmp_path):
    (tmp_path / "log.csv").write_text("t,q,v\n" + table([T, Q, V]))
    columns = (Column("t", "time", "s"), Column("q", "observation"), Column("v", "observation"))
    td = load(tmp_path / "log.csv", columns=LogColumns(columns, header=True, separator=",", free_motion=True))
    assert td["action"].shape == (ROWS - 1, 0)
    with pytest.raises(ValueError, match="free_motion: true, but u has the role action"):
        LogColumns((*columns, Column("u", "action")), free_motion=True)


def test_an_angle_is_unwrapped_behind_its_gear_and_shifted_in_si(tmp_path):
    (tmp_path / "log.yaml").write_text(
        "dt: 0.01\ncolumns:\n"
        "  - {name: q, role: observation, unit: deg, scale: 0.5, offset: 1.0, unwrap: true}\n"
        "  - {name: u, role: action, unit: deg, unwrap: true}\n"
    )
    (tmp_path / "log.txt").write_text("310 130\n330 150\n350 170\n10 -170\n30 -150\n")
    td = load(tmp_path / "log.txt", columns=tmp_path / "log.yaml")
    angle = torch.cat([td["observation"], td["next", "observation"][-1:]])
    assert angle.flatten().tolist() == pytest.approx([1.0 + np.radians(a) for a in (155.0, 165.0, 175.0, 185.0, 195.0)])
    assert td["action"].flatten().tolist() == pytest.approx([np.radians(a) for a in (130.0, 150.0, 170.0, 190.0)])


def test_the_counts_of_an_encoder_are_unwrapped_by_the_size_of_its_turn():
    counts, rad = np.array([4000.0, 4050.0, 4090.0, 30.0, 80.0, 120.0]), 2.0 * np.pi / 4096
    column = Column("q", "observation", unit="rad", scale=rad, unwrap=4096)
    assert column.in_si(counts) == pytest.approx(rad * np.array([4000.0, 4050.0, 4090.0, 4126.0, 4176.0, 4216.0]))
    with pytest.raises(ValueError, match="give the size of its turn, such as unwrap: 4096"):
        Column("q", "observation", unit="rad", scale=rad, unwrap=True).in_si(counts)


def test_lists_in_cells_are_columns(tmp_path):
    rows = "".join(f'{t},"[{q}, {v}]",({u} 0.0)\n' for t, q, v, u in zip(T, Q, V, U, strict=True))
    (tmp_path / "log.csv").write_text("t,state,motor\n" + rows)
    td = load(tmp_path / "log.csv", columns=layout(names=("t", "state[0]", "state[1]", "motor[0]")))
    torch.testing.assert_close(td["observation"][:, 0], torch.from_numpy(np.deg2rad(Q[:-1])).float())
    torch.testing.assert_close(td["action"].flatten(), torch.from_numpy(U[:-1]).float())
    ragged = rows.replace(", ", " ", 1).replace("]", " 0]", 1)
    (tmp_path / "log.csv").write_text("t,state,motor\n" + ragged)
    with pytest.raises(DataError, match=r"the column is missing; the header is t, state, motor\[0\]"):
        load(tmp_path / "log.csv", columns=layout(names=("t", "state[0]", "state[1]", "motor[0]")))


@pytest.mark.parametrize("kind", ["list_", "fixed"])
def test_lists_in_parquet_are_columns_and_a_run_ends_with_its_episode(tmp_path, kind):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    of = pyarrow.list_(pyarrow.float64(), *([2] if kind == "fixed" else []))
    state = pyarrow.array(np.stack([Q, V], 1).tolist(), of)
    names = pyarrow.array([["a"] * (i % 2) for i in range(ROWS)])
    episode = np.arange(ROWS) // 20
    columns = {"t": T % 0.2, "state": state, "u": U, "episode": episode, "names": names}
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    described = layout(names=("t", "state[0]", "state[1]", "u"))
    described = LogColumns(**{**vars(described), "columns": (*described.columns, Column("episode", "run"))})
    found = list(episodes(load(tmp_path / "log.parquet", columns=described)))
    assert [len(run) for run in found] == [19, 19]
    torch.testing.assert_close(found[1]["observation"][:, 0], torch.from_numpy(np.deg2rad(Q[20:-1])).float())


def test_two_arrays_of_one_name_and_encrypted_ones_are_refused(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, t=T, q=Q, v=V, u=U)
    content = path.read_bytes()
    array = io.BytesIO()
    np.save(array, 2.0 * Q)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("q.npy", array.getvalue())
    with pytest.raises(DataError, match="two arrays have this name") as caught:
        load(path, columns=layout())
    assert caught.value.column == "q"
    local, central = content.index(b"PK\x03\x04"), content.index(b"PK\x01\x02")
    marked = bytearray(content)
    marked[local + 6] |= 1
    marked[central + 8] |= 1
    path.write_bytes(bytes(marked))
    with pytest.raises(DataError, match=r"cannot be read as \.npz: .*encrypted"):
        load(path, columns=layout())


def matlab_object(name, kind):
    """A variable of a MATLAB 5 file that is an object, as MATLAB writes it; scipy writes none."""

    def element(number, content):
        return struct.pack("<II", number, len(content)) + content.ljust(-(-len(content) // 8) * 8, b"\0")

    reference = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    reference += element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1))
    parts = (element(1, text.encode()) for text in (name, "MCOS", kind))
    return element(14, element(6, struct.pack("<II", 17, 0)) + b"".join(parts) + element(14, reference))


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", ["timeseries", "timetable"])
def test_objects_of_matlab_are_named_with_what_to_save(tmp_path, kind, compressed):
    from scipy.io import savemat

    savemat(tmp_path / "log.mat", {"t": T})
    added = matlab_object("hip", kind)
    if compressed:
        packed = zlib.compress(added)
        added = struct.pack("<II", 15, len(packed)) + packed
    with (tmp_path / "log.mat").open("ab") as file:
        file.write(added)
    with pytest.raises(DataError, match=rf"column 'hip': it is a {kind}.*t = hip.Time; x = hip.Data; save") as caught:
        load(tmp_path / "log.mat", columns=layout())
    assert caught.value.column == "hip"


def test_an_object_of_matlab_in_a_newer_file_is_named(tmp_path):
    columns = write_mat73(tmp_path / "log.mat")
    with h5py.File(tmp_path / "log.mat", "a") as file:
        file["hip"] = np.zeros((1, 6), np.uint32)
        file["hip"].attrs["MATLAB_class"] = np.bytes_("timeseries")
        file["hip"].attrs["MATLAB_object_decode"] = 3
    with pytest.raises(DataError, match=r"it is a timeseries.*hip\.Data"):
        load(tmp_path / "log.mat", columns=columns)


def linked_to_itself(file):
    file["log/again"] = file["log"]


def linked_twice(file):
    file["log/more"] = file["t"]


@pytest.mark.parametrize("link", [linked_to_itself, linked_twice])
def test_a_group_of_a_matlab_file_that_is_linked_again_is_refused(tmp_path, link):
    """Followed, the links have no end, or give one array any number of names."""
    columns = write_mat73(tmp_path / "log.mat")
    with h5py.File(tmp_path / "log.mat", "a") as file:
        link(file)
    with pytest.raises(DataError, match=r"it is another link to (log|t|log/more);"):
        load(tmp_path / "log.mat", columns=columns)


def test_a_bag_with_damaged_bytes_is_refused(tmp_path):
    path = tmp_path / "log.mcap"
    columns = write_mcap(path)
    whole, content = load(path, columns=columns), path.read_bytes()
    refused = 0
    for place in range(60, len(content) - 400, 397):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x11]) + content[place + 1 :])
        try:
            assert torch.equal(load(path, columns=columns)["observation"], whole["observation"])
        except DataError:
            refused += 1
    assert refused > 3


@pytest.mark.parametrize(
    ("last", "is_whole"),
    [("0.5000", True), ("0.50", False), ("0.", False), ("-1", False), ("0.5000\n", True), ("0.50\n", True)],
)
def test_a_last_cell_that_may_be_cut_is_refused(tmp_path, last, is_whole):
    (tmp_path / "log.csv").write_text("t,q,v,u\n0.00,1,1,0.1234\n0.01,2,2,-0.1230\n0.02,3,3," + last)
    if is_whole:
        assert len(load(tmp_path / "log.csv", columns=layout())) == 2
        return
    with pytest.raises(DataError, match="without a line break, so this number may be cut") as caught:
        load(tmp_path / "log.csv", columns=layout())
    assert (caught.value.column, caught.value.row) == ("u", 4)


def test_a_last_cell_that_is_not_used_or_cannot_be_cut_is_read(tmp_path):
    (tmp_path / "log.csv").write_text("t,q,v,u,mode\n0.00,1,1,0.1234,run\n0.01,2,2,-0.1230,ru")
    assert len(load(tmp_path / "log.csv", columns=layout())) == 1
    (tmp_path / "log.csv").write_text("t,q,v,u\n0.00,1,1,7\n0.01,2,2,-9")
    assert len(load(tmp_path / "log.csv", columns=layout())) == 1


@pytest.mark.parametrize("cell", ["1e20", "-2e12", "\u0661", "\uff11"])
def test_implausible_numbers_and_other_digits_are_refused(tmp_path, cell):
    (tmp_path / "log.csv").write_text(f"t,q,v,u\n0.00,1,1,1\n0.01,2,2,{cell}\n0.02,3,3,1\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"at most 1e\+12|is not a number") as caught:
        load(tmp_path / "log.csv", columns=layout())
    assert (caught.value.column, caught.value.row) == ("u", 3)
