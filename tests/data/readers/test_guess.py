"""Guessed kinds, units and sets of columns."""

import re

import numpy as np
import pytest

from tests.data.readers.guessing import ANGLE, COMMAND, TIME, guessed, renamed
from torchrl_h2o.data import LogColumns, load, read_robot_log
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates
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


def test_names_of_the_model_say_what_a_column_is(tmp_path):
    """None of these words is known: without the model they are left out."""
    units = {"cart": "m", "pole": "rad", "cart_velocity": "m/s", "pole_velocity": "rad/s"}
    rows = np.cumsum(np.ones((20, 6)), axis=0) * [0.01, 0.1, 0.2, 0.1, 0.2, 1.0]
    np.savetxt(
        tmp_path / "log.csv",
        rows,
        delimiter=",",
        header="time,cart,Pole_deg,cart_velocity,pole_velocity,drive",
        comments="",
    )
    text = guess_layout(tmp_path / "log.csv", Coordinates(units, ["drive"]))
    for line in (
        '"cart", role: observation, unit: "m"',
        '"Pole_deg", role: observation, unit: "deg"',
        '"cart_velocity", role: observation, unit: "m/s"',
        '"pole_velocity", role: observation, unit: "rad/s"',
        '"drive", role: action',
    ):
        assert line in text
    assert "role: ignore" not in text
    assert "ignore" in guess_layout(tmp_path / "log.csv")


def test_the_command_of_a_servo_has_the_unit_of_its_position(tmp_path):
    rows = np.cumsum(np.ones((50, 4)), axis=0) * [0.02, 2.0, 1.9, 0.1]
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="time,command,angle,effort", comments="")
    model = Coordinates({"arm": "rad", "arm_velocity": "rad/s"}, ["servo"], servos="position")
    text = guess_layout(tmp_path / "log.csv", model)
    assert '{name: "command", role: action, unit: "deg"}  # the model\'s actuators are position servos' in text
    assert '{name: "effort", role: ignore}' in text


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


def test_the_only_column_left_is_the_action_of_the_only_actuator(tmp_path):
    model = Coordinates({"q": "rad", "q_velocity": "rad/s"}, ["motor"])
    assert "role: action" in guessed(tmp_path, "time,q,drive", [TIME, ANGLE, COMMAND], model)


def test_of_several_columns_left_none_is_taken_for_the_action(tmp_path):
    model = Coordinates({"q": "rad", "q_velocity": "rad/s"}, ["motor"])
    text = guessed(tmp_path, "time,q,drive,other", [TIME, ANGLE, COMMAND, COMMAND], model)
    assert "role: action" not in text


def test_a_numbered_column_that_keeps_its_sign_is_an_action_beside_one_that_does_not(tmp_path):
    model = Coordinates({"q": "rad", "q_velocity": "rad/s"}, ["motor1", "motor2"])
    text = guessed(tmp_path, "time,q,i1,i2", [TIME, ANGLE, COMMAND, COMMAND + 2.0], model)
    assert '"i1", role: action' in text
    assert '"i2", role: action' in text


@pytest.mark.parametrize(("name", "values"), [("temperature", COMMAND), ("ddq", COMMAND), ("drive", TIME)])
def test_what_is_no_command_is_not_taken_for_one(tmp_path, name, values):
    model = Coordinates({"q": "rad", "q_velocity": "rad/s"}, ["motor"])
    assert "role: action" not in guessed(tmp_path, f"time,q,{name}", [TIME, ANGLE, values], model)


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


CART_POLE = Coordinates(
    {"cart": "m", "pole": "rad", "cart_velocity": "m/s", "pole_velocity": "rad/s"}, ["Q"], forces=True
)


def of_cart_pole(tmp_path, names, columns):
    np.savetxt(tmp_path / "log.csv", np.stack(columns, 1), delimiter=",", header=names, comments="")
    return guess_layout(tmp_path / "log.csv", CART_POLE)


def test_of_the_many_columns_of_a_cart_pole_s_log_the_state_and_the_action_are_found(tmp_path):
    """The names are those of a public log; its order is not the model's, and one position never changes."""
    values = {
        "time": TIME,
        "angle_raw": 1000.0 * ANGLE,
        "angle": ANGLE,
        "angleD": 4.0 * np.cos(TIME),
        "angle_cos": np.cos(ANGLE),
        "position": 0.1 * np.sin(3.0 * TIME),
        "positionD": 0.3 * np.cos(3.0 * TIME),
        "angleErr": ANGLE - 1.0,
        "target_position": 0.1 * np.cos(TIME),
        "Q": COMMAND,
        "stickPos": 0.0 * TIME,
        "Q_squared": COMMAND**2,
    }
    found = of_cart_pole(tmp_path, ",".join(values), [*values.values()])
    assert renamed(found) == {
        "angle": "pole",
        "angleD": "pole_velocity",
        "position": "cart",
        "positionD": "cart_velocity",
    }
    kept = [name for name in values if f'"{name}", role: ignore' not in found]
    assert kept == ["time", "angle", "angleD", "position", "positionD", "Q"]
    assert '"position", role: observation, unit: "m", coordinate: "cart"}' in found
    assert "derivative_of" not in found


def test_a_joint_that_does_not_move_in_this_log_is_kept(tmp_path):
    still = 0.0 * TIME
    found = of_cart_pole(tmp_path, "time,angle,position,Q,stickPos", [TIME, ANGLE, still, COMMAND, still])
    assert (renamed(found)["angle"], renamed(found)["position"]) == ("pole", "cart")
    assert '"stickPos", role: ignore}  # does not change' in found


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


def test_a_length_is_not_assigned_to_the_hinge_that_is_left(tmp_path):
    model = Coordinates({"hip": "rad", "knee": "rad", "hip_velocity": "rad/s", "knee_velocity": "rad/s"}, ["motor"])
    columns = np.stack([TIME, ANGLE, ANGLE, COMMAND], 1)
    np.savetxt(tmp_path / "log.csv", columns, delimiter=",", header="t,hip_pos,height,tau", comments="")
    assert "height" not in renamed(guess_layout(tmp_path / "log.csv", model))


def test_positions_whose_names_fit_no_joint_are_assigned_in_order(tmp_path):
    found = of_cart_pole(tmp_path, "time,x,y,Q", [TIME, ANGLE, np.cos(TIME), COMMAND])
    assert (renamed(found)["x"], renamed(found)["y"]) == ("cart", "pole")


def test_a_position_beside_as_many_with_velocities_as_the_model_has_joints_is_the_action(tmp_path):
    """Q is a position by its name; the model's actuator has another name."""
    values = {"time": TIME, "angle": ANGLE, "angleD": 4.0 * np.cos(TIME), "position": 0.1 * np.sin(3.0 * TIME)}
    values |= {"positionD": 0.3 * np.cos(3.0 * TIME), "Q": COMMAND}
    model = Coordinates(CART_POLE.units, ["motor"], forces=True)
    text = guessed(tmp_path, ",".join(values), [*values.values()], model)
    assert '"Q", role: action, unit: "1"' in text
    assert '"positionD", role: observation, unit: "m/s"' in text
    assert "derivative_of" not in text
    (tmp_path / "log.yaml").write_text(text)
    assert read_robot_log(tmp_path / "log.csv", tmp_path / "log.yaml")["action"].shape[1] == 1


def test_positions_with_the_names_of_joints_are_kept_beside_others_with_velocities(tmp_path):
    names = "time,m1_pos,m1_vel,m2_pos,m2_vel,arm_pos,pendulum_pos,tau"
    model = Coordinates({"arm": "rad", "pendulum": "rad", "arm_velocity": "rad/s", "pendulum_velocity": "rad/s"}, ["m"])
    columns = [TIME, ANGLE, 4.0 * np.cos(TIME), ANGLE, 4.0 * np.cos(TIME), ANGLE, ANGLE, COMMAND]
    np.savetxt(tmp_path / "log.csv", np.stack(columns, 1), delimiter=",", header=names, comments="")
    found = renamed(guess_layout(tmp_path / "log.csv", model))
    assert (found["arm_pos"], found["pendulum_pos"]) == ("arm", "pendulum")


def test_a_third_position_does_not_hide_the_only_column_that_nothing_recognised(tmp_path):
    units = {"q_1": "rad", "q_2": "rad", "q_1_velocity": "rad/s", "q_2_velocity": "rad/s"}
    columns = [TIME, ANGLE, 4.0 * np.cos(TIME), ANGLE, 4.0 * np.cos(TIME), ANGLE, COMMAND]
    text = guessed(tmp_path, "time,q_1,v_1,q_2,v_2,yaw,drive", columns, Coordinates(units, ["motor"]))
    assert '"drive", role: action' in text
    assert '"yaw", role: ignore}  # a position beyond the model\'s joints' in text


def test_columns_that_may_be_the_action_say_so(tmp_path):
    model = Coordinates({"q": "rad", "q_velocity": "rad/s"}, ["motor"])
    text = guessed(tmp_path, "time,q,drive,other", [TIME, ANGLE, COMMAND, COMMAND], model)
    assert text.count("perhaps an action: actuators in the model: 1, columns that are left: 2") == 2
    assert "no column of actions was found; see those marked 'perhaps an action'" in text


def roles(text):
    """The role of each column of a guessed layout."""
    return dict(re.findall(r'name: "([^"]+)", role: (\w+)', text))


LEGS = [f"{leg}_{part}" for leg in ("FL", "RR") for part in ("hip", "thigh", "calf")]


@pytest.mark.parametrize(
    ("model", "suffix"),
    [
        (Coordinates({f"{leg}_joint": "rad" for leg in LEGS}, LEGS, servos="position"), "des"),
        (Coordinates(dict.fromkeys(LEGS, "rad"), LEGS, servos="position"), "target"),
        (Coordinates(dict.fromkeys(LEGS, "rad"), [f"m{i}" for i in range(6)], servos="position"), "cmd"),
    ],
    ids=["names of actuators", "names of joints", "as many as actuators"],
)
def test_each_servo_has_a_command(tmp_path, model, suffix):
    joints = list(model.units)
    names = ["time", *joints, *(f"{leg}_{suffix}" for leg in LEGS)]
    found = roles(guessed(tmp_path, ",".join(names), [TIME, *[ANGLE] * 6, *[COMMAND] * 6], model))
    assert [name for name, role in found.items() if role == "action"] == names[7:]
    assert [found[joint] for joint in joints] == ["observation"] * 6


def test_a_column_named_like_an_actuator_is_an_action_beside_others_of_its_number(tmp_path):
    names = "time,hip,hip_velocity,motor1,elevon1,current1"
    columns = [TIME, ANGLE, 4.0 * np.cos(TIME), COMMAND, COMMAND, COMMAND]
    model = Coordinates({"hip": "rad", "hip_velocity": "rad/s"}, ["motor1", "elevon1"])
    found = roles(guessed(tmp_path, names, columns, model))
    assert (found["motor1"], found["elevon1"], found["current1"]) == ("action", "action", "ignore")


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


def test_columns_that_are_no_slopes_stay_positions(tmp_path):
    time = 0.008 * np.arange(1000)
    text = guessed(tmp_path, "q1,q2,u", [np.sin(3.0 * time), np.cos(3.0 * time), time])
    assert text.count("derivative_of") == 2
    model = Coordinates({f"q{i}": "rad" for i in (1, 2)}, ["u"])
    text = guessed(tmp_path, "time,q1,q2,u", [time, np.sin(3.0 * time), 3.0 * np.cos(3.0 * time), time], model)
    assert text.count("derivative_of") == 2  # the model has two joints


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


def test_the_commands_of_velocity_servos_are_desired_velocities(tmp_path):
    model = Coordinates({"hip": "rad", "hip_velocity": "rad/s"}, ["drive"], servos="velocity")
    columns = [TIME, ANGLE, 4.0 * np.cos(TIME), 4.0 * np.cos(TIME) + 0.1, ANGLE, COMMAND]
    found = guessed(tmp_path, "t,hip,hip_vel,hip_vel_des,hip_pos_des,hip_tau", columns, model)
    assert '"hip_vel_des", role: action, unit: "rad/s"}  # the model\'s actuators are velocity servos' in found
    assert '"hip_pos_des", role: ignore' in found
    assert '"hip_tau", role: ignore}  # the model\'s actuators are velocity servos' in found
