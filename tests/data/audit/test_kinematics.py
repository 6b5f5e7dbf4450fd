"""Velocities against the derivatives of their positions: units, signs, exchanged columns, filters and noise."""

import re

import mujoco
import numpy as np
import pytest

from tests.data.audit.recorded import (
    changed,
    measured,
    rows_of,
    scaled,
    severe,
    warned,
)
from torchrl_h2o.data import audit
from torchrl_h2o.residuals import Simulation, StateMap

DEGREES = 180.0 / np.pi
ONE_JOINT = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody><body>
    <joint name="hinge" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/>
  </body></worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("columns", "factor", "words"),
    [
        ([0, 1], DEGREES, "the position looks like degrees"),
        ([2, 3], DEGREES, "the velocity looks like degrees per second"),
        ([1], 1e3, "thousandths"),
    ],
)
def test_units_of_positions_and_velocities(good, simulation, columns, factor, words):
    assert words in severe(changed(good, scaled(columns, factor)), simulation, "kinematics")


@pytest.mark.parametrize(("factor", "step"), [(2.0, "20 ms"), (0.1, "1 ms"), (DEGREES, ""), (-2.0, "")])
def test_one_joint_cannot_tell_a_wrong_unit_from_a_wrong_step(factor, step):
    state_map = StateMap.of_coordinates(("hinge", "hinge_velocity"), ("rad", "rad/s"), (0, 1), num_states=2)
    simulation = Simulation(lambda: mujoco.MjSpec.from_string(ONE_JOINT), 2, state_map, (), "rod")
    torques = 0.3 * np.random.default_rng(0).standard_normal((1500, 1)).cumsum(0) / 20.0
    reached = simulation.rollout(np.zeros((1, 2)), torques[None])[0]
    rows = np.vstack([np.zeros(2), reached]) * [factor, 1.0]
    (found,) = [each for each in audit(measured(rows, torques), simulation).severe if each.check == "kinematics"]
    _, _, said = found.remedy.partition("or the time between two rows: the motion fits ")
    assert said == step


def test_beside_a_sound_joint_the_step_is_not_in_doubt(good, simulation):
    (found,) = [
        each for each in audit(changed(good, scaled([1], 2.0)), simulation).severe if each.check == "kinematics"
    ]
    assert found.remedy == "correct unit, scale or sign of the columns"


def test_degrees_of_positions_and_velocities_are_found_with_the_model(good, simulation):
    words = severe(changed(good, scaled([0, 1, 2, 3], DEGREES)), simulation, "model")
    assert "all angles and their velocities are taken as degrees" in words


@pytest.mark.parametrize("column", [0, 3])
def test_sign_of_a_position_or_velocity(good, simulation, column):
    assert "wrong sign" in severe(changed(good, scaled([column], -1.0)), simulation, "kinematics")


def test_reversed_joint_is_found_with_the_model(good, simulation):
    assert "elbow and its velocity are reversed" in severe(changed(good, scaled([1, 3], -1.0)), simulation, "model")


def test_exchanged_columns(good, simulation):
    swapped = changed(good, lambda rows: rows[:, [0, 3, 2, 1]])
    assert "elbow and elbow_velocity are exchanged" in severe(swapped, simulation, "kinematics")
    velocities = changed(good, lambda rows: rows[:, [0, 1, 3, 2]])
    assert "the derivative of shoulder is elbow_velocity" in severe(velocities, simulation, "kinematics")
    joints = changed(good, lambda rows: rows[:, [1, 0, 3, 2]])
    assert "shoulder and elbow are exchanged" in severe(joints, simulation, "model")


def test_zero_of_an_angle(good, simulation):
    words = warned(changed(good, lambda rows: rows + np.array([0.4, 0, 0, 0])), simulation, "model")
    assert float(re.findall(r"the zero of shoulder is shifted by (\S+) rad", words)[0]) == pytest.approx(0.4, abs=0.02)


def test_wrapped_angle(good, simulation):
    wrapped = changed(good, lambda rows: np.hstack([np.mod(rows[:, :1], 2.0 * np.pi), rows[:, 1:]]))
    assert "shoulder jumps by 2 π" in warned(wrapped, simulation, "kinematics")


def test_filtered_velocity(good, simulation):
    def late(rows: np.ndarray) -> np.ndarray:
        rows[3:, 2] = rows[:-3, 2].copy()
        return rows

    assert "shoulder_velocity is late by 3." in warned(changed(good, late), simulation, "kinematics")


def test_noise(good, simulation):
    noise = 0.3 * rows_of(good).std(0) * np.random.default_rng(0).standard_normal(rows_of(good).shape)
    found = audit(changed(good, lambda rows: rows + noise), simulation)
    assert sum("has noise of" in finding.words for finding in (*found.severe, *found.warnings)) == 4
