"""Guessed columns that belong to the joints and actuators of a model."""

import re

import numpy as np
import pytest

from tests.data.readers.guessing import ANGLE, COMMAND, TIME, guessed, renamed
from torchrl_h2o.data import read_robot_log
from torchrl_h2o.data.readers.guess import guess_layout
from torchrl_h2o.data.readers.guess.coordinates import Coordinates


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


def test_columns_that_are_no_slopes_stay_positions(tmp_path):
    time = 0.008 * np.arange(1000)
    text = guessed(tmp_path, "q1,q2,u", [np.sin(3.0 * time), np.cos(3.0 * time), time])
    assert text.count("derivative_of") == 2
    model = Coordinates({f"q{i}": "rad" for i in (1, 2)}, ["u"])
    text = guessed(tmp_path, "time,q1,q2,u", [time, np.sin(3.0 * time), 3.0 * np.cos(3.0 * time), time], model)
    assert text.count("derivative_of") == 2  # the model has two joints


def test_the_commands_of_velocity_servos_are_desired_velocities(tmp_path):
    model = Coordinates({"hip": "rad", "hip_velocity": "rad/s"}, ["drive"], servos="velocity")
    columns = [TIME, ANGLE, 4.0 * np.cos(TIME), 4.0 * np.cos(TIME) + 0.1, ANGLE, COMMAND]
    found = guessed(tmp_path, "t,hip,hip_vel,hip_vel_des,hip_pos_des,hip_tau", columns, model)
    assert '"hip_vel_des", role: action, unit: "rad/s"}  # the model\'s actuators are velocity servos' in found
    assert '"hip_pos_des", role: ignore' in found
    assert '"hip_tau", role: ignore}  # the model\'s actuators are velocity servos' in found
