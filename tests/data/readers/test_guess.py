"""Guessed kinds, units and sets of columns."""

import numpy as np
import pytest

from torchrl_h2o.data import LogColumns, load
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.roles import guess_columns


def test_of_commanded_and_measured_actions_one_set_is_taken(shared_data, tmp_path):
    log = shared_data / "double_pendulum" / "trajectory_00.csv"
    (tmp_path / "log.yaml").write_text(guess_layout(log).text)
    layout = LogColumns.load(tmp_path / "log.yaml")
    assert layout.action == ("tau_con1", "tau_con2")
    assert layout.observation == ("pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2")
    assert layout.on_time_jump == "split"
    assert len(load(log, columns=layout)) > 4900


@pytest.mark.parametrize(
    ("name", "kind", "unit"),
    [
        ("timestamp", "time", "s"),
        ("theta", "position", "rad"),
        ("theta_dot", "velocity", "rad/s"),
        ("hipVel", "velocity", "rad/s"),
        ("x", "position", "m"),
        ("dq1", "velocity", "rad/s"),
        ("motor1_vel_rpm", "velocity", "rpm"),
        ("motor1_pos_deg", "position", "deg"),
        ("kneeTorque_Nm", "action", "Nm"),
        ("i_q current", "action", "A"),
        ("tau_des", "action", "N·m"),
        ("pos_des", "desired", "1"),
        ("q[1]", "position", "rad"),
        ("v (m/s)", "velocity", "m/s"),
        ("done", "done", "1"),
        ("temperature", "unknown", "1"),
    ],
)
def test_kinds_and_units_by_name(name, kind, unit):
    (guess,) = guess_columns({name: 0.01 * np.arange(10.0)})
    assert (guess.kind, guess.unit) == (kind, unit)
