"""Guessed kinds, units and sets of columns."""

import re

import numpy as np
import pytest

from tests.data.readers.guessing import ANGLE, COMMAND, TIME, guessed
from torchrl_h2o.data import LogColumns, load, read_robot_log
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.roles import guess_columns


def test_of_commanded_and_measured_actions_one_set_is_taken(shared_data, tmp_path):
    log = shared_data / "double_pendulum" / "trajectory_00.csv"
    (tmp_path / "log.yaml").write_text(guess_layout(log))
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
        ("alphadot", "velocity", "rad/s"),
        ("dtheta", "velocity", "rad/s"),
        ("Vin", "action", "V"),
        ("x", "position", "m"),
        ("dq1", "velocity", "rad/s"),
        ("angleD", "velocity", "rad/s"),
        ("angle_cos", "unknown", "rad"),
        ("cur_pos", "position", "rad"),
        ("current_position", "position", "rad"),
        ("encD", "position", "rad"),
        ("pitch_d", "position", "rad"),
        ("torque_sin", "action", "N·m"),
        ("Q_squared", "unknown", "rad"),
        ("motor1_vel_rpm", "velocity", "rpm"),
        ("motor1_pos_deg", "position", "deg"),
        ("kneeTorque_Nm", "action", "Nm"),
        ("i_q current", "action", "A"),
        ("iq_2", "action", "A"),
        ("motor_volts", "action", "V"),
        ("pwm", "action", "1"),
        ("tau_des", "action", "N·m"),
        ("pos_des", "desired position", "rad"),
        ("target_moment_shoulder", "action", "N·m"),
        ("hip_vel_ref", "desired velocity", "rad/s"),
        ("q[1]", "position", "rad"),
        ("v (m/s)", "velocity", "m/s"),
        ("done", "done", "1"),
        ("temperature", "unknown", "1"),
    ],
)
def test_kinds_and_units_by_name(name, kind, unit):
    (guess,) = guess_columns({name: 0.01 * np.arange(10.0)})
    assert (guess.kind, guess.unit) == (kind, unit)


STEADY, TURNING = [7.3, 7.4, np.nan, 8.5], [-7.3, 7.4, 7.4, 7.4]


@pytest.mark.parametrize(("volts", "kind"), [(STEADY, "unknown"), (TURNING, "action")])
def test_a_voltage_that_hardly_changes_is_that_of_a_supply(volts, kind):
    pwm, supply = guess_columns({"pwm": np.array([0.0, 885.0, -885.0, 0.0]), "input_volts": np.array(volts)})
    assert (pwm.kind, supply.kind) == ("action", kind)
    assert "scale" in pwm.note


def test_a_steady_voltage_is_the_action_where_it_is_the_only_one_or_the_models():
    (alone,) = guess_columns({"motor_voltage": np.full(5, 6.0)})
    named, _ = guess_columns({"voltage": np.full(5, 6.0), "tau": np.arange(5.0)}, {"voltage": ("action", None)})
    assert (alone.kind, alone.unit, named.kind) == ("action", "V", "action")


def test_irregular_stamps_are_resampled(tmp_path):
    """The written file can be read, also with a velocity that is estimated."""
    path = tmp_path / "log.csv"
    time = np.cumsum(0.01 + 0.004 * np.random.default_rng(0).uniform(-1, 1, 300))
    rows = "".join(f"{t:.9f},{np.sin(t):.9f},{np.cos(t):.9f}\n" for t in time)
    path.write_text("t,hip,tau\n" + rows)
    text = guess_layout(path)
    assert "resample: 0.0" in text
    (tmp_path / "log.yaml").write_text(text)
    td = read_robot_log(path, tmp_path / "log.yaml")
    assert td["observation"].shape[1] == 2
    assert np.diff(td["time"].flatten().numpy()) == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize(("unit", "factor"), [("rad", 1.0), ("deg", 180.0 / np.pi)])
def test_an_angle_that_jumps_by_a_turn_is_unwrapped(tmp_path, unit, factor):
    wrapped = np.angle(np.exp(1j * ANGLE)) * factor
    text = guessed(tmp_path, f"time,q_{unit},tau", [TIME, wrapped, TIME])
    assert "unwrap: true" in text
    (tmp_path / "log.yaml").write_text(text)
    read = read_robot_log(tmp_path / "log.csv", tmp_path / "log.yaml")["observation"][:, 0].numpy()
    assert read == pytest.approx(4.0 * np.sin(TIME[3 : 3 + len(read)]), abs=1e-3)


def test_an_angle_that_is_read_wrongly_now_and_then_is_not_unwrapped(tmp_path):
    broken = ANGLE + 3.0 * (np.arange(1500) % 50 == 0)
    assert "unwrap" not in guessed(tmp_path, "time,q,tau", [TIME, broken, TIME])


def test_a_velocity_that_does_not_follow_its_position_is_estimated_instead(tmp_path):
    wrong = guessed(tmp_path, "time,q,qdot,tau", [TIME, ANGLE, ANGLE, TIME])
    assert '"qdot", role: ignore}  # not the slope of q (correlation' in wrong
    assert 'derivative_of: "q"' in wrong
    right = guessed(tmp_path, "time,q,qdot,tau", [TIME, ANGLE, 4.0 * np.cos(TIME), TIME])
    assert '"qdot", role: observation' in right
    assert "derivative_of" not in right


def test_an_estimated_velocity_has_a_name_of_its_own(tmp_path):
    text = guessed(tmp_path, "time,hip,hip_velocity,tau", [TIME, ANGLE, ANGLE, COMMAND])
    assert 'name: "hip_velocity_estimated", role: observation, derivative_of: "hip"' in text
    (tmp_path / "log.yaml").write_text(text)
    assert read_robot_log(tmp_path / "log.csv", tmp_path / "log.yaml")["observation"].shape[1] == 2


RESETS = 0.5 * (np.arange(1500) // 50 % 2)


RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("time", "position", "velocity"),
    [
        (TIME, np.sin(8.0 * np.pi * TIME), 8.0 * np.pi * np.cos(8.0 * np.pi * TIME) + 0.05),
        (TIME, ANGLE + RESETS, 4.0 * np.cos(TIME)),
        (TIME + 60.0 * (TIME > 7.0), ANGLE, 4.0 * np.cos(TIME)),
        (TIME, ANGLE + 0.01 * RANDOM.standard_normal(1500), 4.0 * np.cos(TIME) + 0.5),
        (TIME, 0.01 * RANDOM.standard_normal(1500), RANDOM.standard_normal(1500)),
    ],
    ids=["a period of 25 rows, biased", "resets", "a gap", "noise and bias", "at rest"],
)
def test_a_sound_velocity_is_kept(tmp_path, time, position, velocity):
    assert "derivative_of" not in guessed(tmp_path, "time,q,qdot,tau", [time, position, velocity, COMMAND])


def test_a_gap_far_behind_the_beginning_is_seen(tmp_path):
    time = np.arange(9000) * 0.01
    time[8000:] += 1.0
    text = guessed(tmp_path, "time,q,tau", [time, np.sin(time), np.cos(7.0 * time)])
    assert "on_time_jump: split" in text


def test_a_raw_column_is_kept_where_no_other_one_moves(tmp_path):
    text = guessed(tmp_path, "time,q_raw,tau", [TIME, ANGLE, COMMAND])
    assert '"q_raw", role: observation' in text


def test_a_raw_column_is_kept_beside_a_constant_one(tmp_path):
    text = guessed(tmp_path, "time,q_raw,q,tau", [TIME, ANGLE, 0.0 * TIME, COMMAND])
    assert '"q_raw", role: observation' in text


def roles(text):
    """The role of each column of a guessed layout."""
    return dict(re.findall(r'name: "([^"]+)", role: (\w+)', text))


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1)])
def test_of_several_sets_of_velocities_the_one_that_are_slopes_is_taken(tmp_path, order):
    moving = [ANGLE, 3.0 * np.sin(2.0 * TIME)]
    sets = [moving, [np.cos(5.0 * TIME)] * 2, [4.0 * np.cos(TIME), 6.0 * np.cos(2.0 * TIME)]]
    names = [[f"{name}[{i}]" for i in range(2)] for name in ("local_position", "local_rate", "local_velocity")]
    columns = [column for index in order for column in sets[index]]
    header = ",".join(name for index in order for name in names[index])
    found = roles(guessed(tmp_path, f"time,{header},tau", [TIME, *columns, COMMAND]))
    assert [found[name] for name in (*names[1], *names[2])] == ["ignore", "ignore", "observation", "observation"]


@pytest.mark.parametrize(("names", "order"), [("q1,q2,q3,q4", (0, 1, 2, 3)), ("q1,q2,q3,q4", (0, 2, 1, 3))])
@pytest.mark.parametrize("timed", [False, True])
def test_slopes_are_velocities_also_where_no_name_tells_it(tmp_path, names, order, timed):
    time = 0.008 * np.arange(1000)
    columns = [np.sin(3.0 * time), np.cos(1.7 * time), 3.0 * np.cos(3.0 * time), -1.7 * np.sin(1.7 * time)]
    columns = [*([time] if timed else []), *(columns[i] for i in order), np.cos(7.0 * time)]
    text = guessed(tmp_path, ("time," if timed else "") + names + ",u", columns)
    assert "derivative_of" not in text
    assert text.count('unit: "rad/s"') == 2
    assert timed or float(text.split("dt: ")[1].split()[0]) == pytest.approx(0.008, rel=0.01)


def test_a_regular_clock_without_a_name_is_the_time(tmp_path):
    time = 0.002 * np.arange(500)
    np.savetxt(tmp_path / "log.dat", np.stack([time, np.sin(3 * time), 3 * np.cos(3 * time), np.cos(9 * time)], 1))
    text = guess_layout(tmp_path / "log.dat")
    assert list(roles(text).values()) == ["time", "observation", "observation", "ignore"]
    assert "the median step is 0.002, which is 0.002 s" in text


@pytest.mark.parametrize("values", [np.arange(1500.0), np.sin(0.1 * TIME), TIME + 0.01 * (np.arange(1500) % 3)])
def test_what_counts_rows_or_grows_unevenly_is_no_clock(tmp_path, values):
    assert roles(guessed(tmp_path, "a,q,tau", [values, ANGLE, COMMAND]))["a"] == "ignore"


def test_lists_in_cells_are_described_one_by_one(tmp_path):
    rows = "".join(f'{t:.2f},"[{np.sin(t):.6f}, {t:.2f}]","[{np.cos(t):.6f}, 1.0]"\n' for t in TIME[:200])
    (tmp_path / "log.csv").write_text("t,positions,velocities\n" + rows)
    found = roles(guess_layout(tmp_path / "log.csv"))
    assert list(found) == ["t", "positions[0]", "positions[1]", "velocities[0]", "velocities[1]"]
    (tmp_path / "log.yaml").write_text(guess_layout(tmp_path / "log.csv"))
    assert load(tmp_path / "log.csv", columns=tmp_path / "log.yaml")["observation"].shape == (199, 4)


def test_the_number_of_an_episode_separates_runs(tmp_path):
    episode = np.arange(1500) // 500
    text = guessed(tmp_path, "t,q,tau,episode_index", [TIME % 5.0, ANGLE, COMMAND, episode])
    assert roles(text)["episode_index"] == "run"
    (tmp_path / "log.yaml").write_text(text)
    read = load(tmp_path / "log.csv", columns=tmp_path / "log.yaml")
    assert int(read["next", "done"].sum()) == 3


@pytest.mark.parametrize(("rate", "unit"), [(0.2, "rad"), (3.0, "deg")])
def test_positions_and_their_slopes_have_the_same_unit_of_angle(tmp_path, rate, unit):
    """An angle of 28 is four turns if its velocity is at most 6, or degrees if it is at most 84."""
    found = guessed(
        tmp_path, "t,hip,hip_vel,tau", [TIME, 28.0 * np.sin(rate * TIME), 28.0 * rate * np.cos(rate * TIME), COMMAND]
    )
    assert f'"hip", role: observation, unit: "{unit}"' in found
    assert f'"hip_vel", role: observation, unit: "{unit}/s"' in found
