"""One log, written in every format that the readers accept."""

import h5py
import numpy as np
import pytest

from torchrl_h2o.data import Column, LogColumns

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
