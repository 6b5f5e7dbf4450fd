"""The time between two rows of a log without a time, guessed from velocities and positions."""

import numpy as np
import pytest

from tests.data.readers.guessing import ANGLE, COMMAND, TIME, guessed

SPEED = 4.0 * np.cos(TIME)  # of ANGLE
LOST = np.where(np.arange(1500) == 700, np.nan, 1.0)


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        ("q,qdot", [ANGLE, SPEED]),
        ("q [rad],w [rpm]", [ANGLE, SPEED * 30.0 / np.pi]),
        ("q,qdot", [np.degrees(ANGLE), np.degrees(SPEED)]),  # no unit is stated, and the angle is taken for degrees
        ("q,qdot", [(ANGLE + np.pi) % (2.0 * np.pi), SPEED]),
        ("q,qdot", [ANGLE, SPEED + 0.5 * np.random.default_rng(0).standard_normal(1500)]),
        ("q1,qdot1,q2 [deg],qdot2 [rad/s]", [ANGLE, SPEED, np.degrees(ANGLE), SPEED]),
        ("q,qdot", [ANGLE, LOST * SPEED]),
        ("q,qdot", [LOST * ANGLE, SPEED]),
    ],
    ids=["same units", "other units", "degrees", "wrapped", "noise", "two joints", "lost velocity", "lost position"],
)
def test_without_a_time_its_step_follows_from_velocities_and_positions(tmp_path, names, columns):
    text = guessed(tmp_path, f"{names},tau", [*columns, COMMAND])
    assert "# no column of time was found; with this time between two rows" in text
    assert float(text.split("dt: ")[1].split()[0]) == pytest.approx(0.01, rel=0.03)


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        ("q1,qdot1,q2,qdot2", [ANGLE, SPEED, ANGLE, SPEED / 4.0]),
        ("q,qdot", [ANGLE, COMMAND + TIME]),
        ("q,qdot [deg/s]", [ANGLE, np.degrees(SPEED)]),
        ("q,qdot", [1e4 * ANGLE, SPEED]),
    ],
    ids=["two steps", "not its velocity", "one unit", "no such step"],
)
def test_without_a_time_no_step_is_made_up(tmp_path, names, columns):
    text = guessed(tmp_path, f"{names},tau", [*columns, COMMAND])
    assert "dt: 0.01  # no column of time was found: give the time" in text


def test_of_a_short_log_no_step_is_made_up(tmp_path):
    text = guessed(tmp_path, "q,qdot,tau", [column[:60] for column in (np.sin(TIME), -np.sin(1.1 * TIME), COMMAND)])
    assert "dt: 0.01  # no column of time was found: give the time" in text
