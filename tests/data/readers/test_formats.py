"""The same log in every format, and the columns that a layout chooses."""

import numpy as np
import pytest
import torch

from tests.data.readers.log_files import FORMATS, ROWS, Q, T, U, V, joint_state, layout, table, write_bag
from torchrl_h2o.data import Column, DataError, LogColumns, episodes, load, read_robot_log


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


@pytest.mark.parametrize("cell", ["1e20", "-2e12", "\u0661", "\uff11"])
def test_implausible_numbers_and_other_digits_are_refused(tmp_path, cell):
    (tmp_path / "log.csv").write_text(f"t,q,v,u\n0.00,1,1,1\n0.01,2,2,{cell}\n0.02,3,3,1\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"at most 1e\+12|is not a number") as caught:
        load(tmp_path / "log.csv", columns=layout())
    assert (caught.value.column, caught.value.row) == ("u", 3)
