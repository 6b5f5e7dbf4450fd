"""Audits of good and of damaged logs of a motored arm."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from tests.data.audit.recorded import (
    NAMES,
    XML,
    arm,
    changed,
    holding,
    measured,
    pumped,
    recording,
    rows_of,
    scaled,
    severe,
    swinging,
    warned,
    with_action,
)
from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.data import Audit, DataError, Finding, audit
from torchrl_h2o.data.audit.log import Log
from torchrl_h2o.data.audit.response import Response
from torchrl_h2o.data.audit.rows import check_rows
from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.effects import ActionDelay, ActionGain, Armature, BodyMass, Gravity, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals import Simulation, StateMap

DEGREES = 180.0 / np.pi


def test_good_log_has_neither_severe_findings_nor_warnings(good, simulation):
    found = audit(good, simulation)
    assert found.severe == found.warnings == ()


@pytest.mark.parametrize(
    "effect",
    [
        JointFrictionLoss(0.15),
        Armature(0.02),
        ActionDelay(0.015),
        pytest.param(ActionGain(0.7), marks=pytest.mark.slow),
        pytest.param(BodyMass(1.5), marks=pytest.mark.slow),
        pytest.param(Gravity(2.0), marks=pytest.mark.slow),
    ],
    ids=lambda effect: type(effect).__name__,
)
def test_dynamics_gap_is_no_fault_of_the_data(effect, simulation):
    assert audit(recording(effect), simulation).severe == ()


@pytest.mark.parametrize(
    "effects",
    [(), pytest.param((JointFrictionLoss(0.15), Gravity(2.0)), marks=pytest.mark.slow)],
    ids=["no gap", "a gap"],
)
def test_free_motion_of_a_model_without_actuators_has_no_severe_findings(effects):
    data, simulation = swinging(*effects)
    assert audit(data, simulation).severe == ()


def test_a_wrong_zero_is_found_without_actuators():
    data, simulation = swinging(zero=0.3)
    assert "zero of shoulder is shifted" in warned(data, simulation, "model")


def test_short_delay_of_a_drive_is_a_note(simulation):
    found = audit(recording(ActionDelay(0.02)), simulation)
    (late,) = [finding for finding in found.findings if finding.check == "actions"]
    assert late.severity == "note"
    assert "2 rows (20 ms) later" in late.words


@pytest.mark.parametrize("lag", [0, 2])
def test_late_velocities_are_no_lag_of_the_actions(good, simulation, lag):
    rows = rows_of(good)
    rows[3:, 2:] = rows[:-3, 2:].copy()
    data = measured(rows[:-3], np.vstack([good.action[lag:], good.action[:lag]])[:-3])
    found = " ".join(str(finding) for finding in audit(data, simulation).findings if finding.check == "actions")
    assert found == "" if lag == 0 else "2 rows (20 ms) later" in found


def test_actions_of_another_run(good, simulation):
    other = with_action(good, recording(seed=1).action)
    assert "another run" in severe(other, simulation, "actions")


@pytest.mark.parametrize("noise", [pytest.param(0.02, marks=pytest.mark.slow), 0.1])
def test_torques_that_follow_the_velocity_are_not_blamed_for_a_heavier_robot(simulation, noise):
    """Earlier, their sign was called reversed or they were called 300 ms late: they act as viscous friction does."""
    found = audit(pumped(BodyMass(2.4), JointFrictionLoss(0.1), noise=noise), simulation)
    assert [finding for finding in (*found.severe, *found.warnings) if finding.check == "actions"] == []


def test_sign_of_an_action(good, simulation):
    words = severe(with_action(good, good.action * [1.0, -1.0]), simulation, "actions")
    assert "the action of m2 has the other sign" in words


def test_late_actions(good, simulation):
    shifted = measured(rows_of(good)[:-12], good.action[12:])
    assert "12 rows (120 ms) later" in severe(shifted, simulation, "actions")


def test_unit_of_the_actions(good, simulation):
    assert "looks like another unit" in severe(with_action(good, 1e3 * good.action), simulation, "actions")


def test_unit_of_the_actions_of_a_held_arm(simulation):
    """Nearly all of the torque holds the arm's weight, as friction could."""
    data = holding()
    sound = audit(data, simulation)
    assert sound.warnings == sound.severe == ()
    assert "looks like another unit" in severe(with_action(data, 50.0 * data.action), simulation, "actions")


def test_arm_whose_friction_takes_most_of_the_torque_is_no_other_robot(simulation):
    """Without friction, the simulator is wrong by several times the motion; no unit of the angles explains that."""
    friction = JointFrictionLoss(1.2, "shoulder"), JointFrictionLoss(0.3, "elbow"), JointDamping(1.0, "shoulder")
    found = audit(recording(*friction), simulation)
    assert found.severe == found.warnings == ()


def test_exchanged_actions(good, simulation):
    assert "exchanged" in severe(with_action(good, good.action[:, ::-1].copy()), simulation, "actions")


def test_constant_actions_are_severe_only_if_the_motion_contradicts_them(good, simulation):
    assert "in all rows" in severe(with_action(good, np.zeros_like(good.action)), simulation, "actions")
    start = np.array([[1.0, 0.5, 0.0, 0.0]])
    still = np.zeros((1500, 2))
    swing = np.vstack([start, simulation.rollout(start, still[None])[0]])
    assert audit(measured(swing, still), simulation).severe == ()


@pytest.mark.parametrize(("factor", "words"), [(1e3, "ms that are declared as s"), (2.0, "control step")])
def test_wrong_time_stamps(good, simulation, factor, words):
    data = measured(rows_of(good), good.action, factor * good.time)
    assert words in severe(data, simulation, "time")


def test_irregular_time_stamps(good, simulation):
    steps = 0.01 * np.random.default_rng(0).uniform(0.5, 1.5, len(good))
    data = measured(rows_of(good), good.action, np.cumsum(steps))
    assert "differ from the usual" in severe(data, simulation, "time")


def test_left_out_rows_are_a_wrong_time_step(good, simulation):
    every_third = measured(rows_of(good)[::3], good.action[::3][:666])
    assert "the time between two rows were 0.03" in severe(every_third, simulation, "time")


def test_reversed_rows(good, simulation):
    words = severe(measured(rows_of(good)[::-1], good.action[::-1]), simulation, "time")
    assert "reverse order" in words


def test_shuffled_rows(good, simulation):
    order = np.random.default_rng(0).permutation(len(good))
    words = severe(measured(rows_of(good)[np.append(order, 0)], good.action[order]), simulation, "rows")
    assert "were put into another order" in words


def test_a_joint_that_rattles_between_near_ends_does_not_jump(good, simulation):
    def rattles(rows):
        rng = np.random.default_rng(0)
        rows[:, 1], rows[:, 3] = rng.uniform(-0.01, 0.01, len(rows)), rng.uniform(-5.0, 5.0, len(rows))
        return rows

    found = check_rows(Log.of(changed(good, rattles), simulation), simulation)
    assert not any("jump" in finding.words for finding in found)


def test_shuffled_transitions(good, simulation):
    order = np.random.default_rng(0).permutation(len(good))
    ends = np.zeros(len(good), bool)
    data = to_ted(
        observation=good.observation[order],
        action=good.action[order],
        next_observation=good.following[order],
        terminated=ends,
        truncated=ends,
    )
    assert "shuffled or thinned" in severe(data, simulation, "rows")


def test_lost_rows_are_listed(good, simulation):
    rows = np.delete(rows_of(good), np.arange(700, 760), axis=0)
    found = audit(measured(rows, np.delete(good.action, np.arange(700, 760), axis=0)), simulation)
    (jump,) = [finding for finding in found.warnings if finding.check == "rows"]
    assert jump.rows.ranges == ((699, 699),)


def test_repeated_rows(good, simulation):
    rng = np.random.default_rng(0)

    def repeat(rows: np.ndarray) -> np.ndarray:
        lost = rng.random(len(rows)) < 0.3
        lost[0] = False
        return rows[np.maximum.accumulate(np.where(lost, 0, np.arange(len(rows))))]

    assert "repeat the row before" in severe(changed(good, repeat), simulation, "rows")


def test_rows_that_were_recorded_twice(good, simulation):
    twice = measured(np.vstack([rows_of(good)[:-1], rows_of(good)]), np.vstack([good.action, good.action]))
    assert any("occur a second time" in finding.words for finding in audit(twice, simulation).warnings)


@pytest.mark.parametrize("column", [0, 3])
def test_frozen_column(good, simulation, column):
    def freeze(rows: np.ndarray) -> np.ndarray:
        rows[1000:, column] = rows[1000, column]
        return rows

    assert "is frozen" in severe(changed(good, freeze), simulation, "rows")


@pytest.mark.parametrize("column", [0, 3])
def test_clipped_column(good, simulation, column):
    def clip(rows: np.ndarray) -> np.ndarray:
        rows[:, column] = rows[:, column].clip(0.5 * rows[:, column].min(), 0.5 * rows[:, column].max())
        return rows

    assert "the signal is clipped" in warned(changed(good, clip), simulation, "rows")


@pytest.mark.parametrize("column", [0, 3])
def test_coarse_column(good, simulation, column):
    def round_off(rows: np.ndarray) -> np.ndarray:
        step = 0.25 * rows[:, column].std()
        rows[:, column] = step * np.round(rows[:, column] / step)
        return rows

    assert "has a resolution of" in warned(changed(good, round_off), simulation, "rows")


def test_effects_that_look_alike_come_with_what_to_record(simulation):
    """Torques that follow the velocity look like viscous friction."""
    rng = np.random.default_rng(0)
    observed, action = np.zeros((2001, 4)), np.zeros((2000, 2))
    observed[0, 0] = 1.5
    for row in range(2000):
        action[row] = 0.15 * np.array([1.0, 0.3]) * observed[row, 2:] + 0.02 * rng.standard_normal(2)
        observed[row + 1] = simulation.rollout(observed[row : row + 1], action[row : row + 1][:, None])[0, -1]
    notes = [finding for finding in audit(measured(observed, action), simulation).findings if "alike" in finding.words]
    (note,) = [finding for finding in notes if finding.words.startswith("viscous friction and motor gain of shoulder")]
    assert note.severity == "note"
    assert "actions that do not follow the velocity" in note.remedy


def test_audit_survives_json(good, simulation):
    found = audit(changed(good, scaled([0], -1.0)), simulation)
    assert Audit.from_dict(json.loads(json.dumps(found.to_dict()))) == found
    assert found.words().startswith("severe, kinematics: ")


def test_short_logs_are_not_compared_with_the_simulator(good, simulation):
    found = audit(measured(rows_of(good)[:30], good.action[:29]), simulation)
    assert any("too few" in finding.words for finding in found.findings)


def test_wrong_width_is_refused(good, simulation):
    data = measured(rows_of(good)[:, :3], good.action)
    with pytest.raises(DataError, match="the data have 3 entries, the simulator has 4"):
        audit(data, simulation)


def test_unknown_severity_is_refused():
    with pytest.raises(ValueError, match="'bad' must be one of severe, warning, note"):
        Finding("rows", "bad", "words")


def test_ted_and_measured_give_the_same_findings(good, simulation):
    ends = np.zeros(len(good), bool)
    data = to_ted(
        observation=good.observation,
        action=good.action,
        next_observation=good.following,
        terminated=ends,
        truncated=ends,
    )
    data["time"] = torch.from_numpy(good.time)[:, None]
    assert [f.words for f in audit(data, simulation).findings][:2] == [
        f.words for f in audit(good, simulation).findings
    ][:2]


def test_real_log_that_cannot_tell_friction_from_gain_says_so(shared_data):
    """In this log the torque follows the sign of the velocity, as its description says."""
    folder = shared_data / "double_pendulum"
    table = np.genfromtxt(folder / "trajectory_00.csv", delimiter=",", skip_header=1)[8:]
    real = Simulation.from_mjcf(folder / "double_pendulum.xml", NAMES, 0.002)
    found = audit(measured(table[:, 1:5], table[:-1, 7:9], table[:-1, 0]), real)
    assert found.severe == ()
    (note,) = [finding for finding in found.findings if finding.words.startswith("motor gain of shoulder is weak")]
    assert "friction" in note.words


def test_windows_are_longer_where_velocities_have_larger_errors(good, simulation):
    log = Log.of(good, simulation)
    horizons = [Response.of(log, simulation, share * good.observation.std(0)).horizon for share in (0.0, 0.3)]
    assert horizons[0] < horizons[1]


def test_actions_of_an_arm_with_heavy_rotors_are_not_exchanged(simulation):
    """Without the rotors, a gain of every action on every joint fits best, and the shoulder's own one is small."""
    rng, time = np.random.default_rng(0), 0.01 * np.arange(2000)
    action = np.zeros((2000, 2))
    for harmonic in range(1, 6):
        for motor, size in enumerate((8.0, 3.0)):
            wave = np.sin(0.2 * np.pi * harmonic * time + rng.uniform(0.0, 6.28))
            action[:, motor] += size * wave * rng.uniform(0.3, 1.0)
    reality = arm(Armature(6.0, "shoulder"), Armature(0.2, "elbow"))
    rows = np.vstack([np.zeros(4), reality.rollout(np.zeros((1, 4)), action[None])[0]])
    rows += 0.001 * rows.std(0) * rng.standard_normal(rows.shape)
    assert audit(measured(rows, action), simulation).severe == ()


def test_actions_are_late_and_not_reversed_where_motors_have_a_filter():
    """Activations follow the actions of each hypothesis."""
    general = '<general name="m{}" joint="{}" dyntype="filter" dynprm="0.1"/>'
    motors = "".join(general.format(*one) for one in ((1, "shoulder"), (2, "elbow")))
    xml = f"{XML[: XML.index('<actuator>')]}<actuator>{motors}</actuator></mujoco>"
    simulation, rng = replace(arm(), spec=lambda: mujoco.MjSpec.from_string(xml)), np.random.default_rng(0)
    action = np.zeros((2000, 2))
    for row in range(1, len(action)):
        action[row] = 0.9 * action[row - 1] + np.array([2.0, 0.5]) * rng.standard_normal(2)
    rows = np.vstack([np.zeros(4), simulation.rollout(np.zeros((1, 4)), action[None])[0][:, :4]])
    rows += 0.005 * rows.std(0) * rng.standard_normal(rows.shape)
    late = audit(measured(rows, np.roll(action, -6, axis=0)), simulation)
    assert late.severe == ()
    assert "6 rows (60 ms) later" in late.warnings[0].words
    assert "m1 has the other sign" in severe(measured(rows, action * [-1.0, 1.0]), simulation, "actions")


def test_a_motor_that_moves_nothing_observed_has_no_unit(good):
    gripper = '<body><joint name="grip" type="slide"/><geom size="0.01" mass="0.1"/></body></worldbody>'
    xml = XML.replace("</worldbody>", gripper).replace("</actuator>", '<motor name="m3" joint="grip"/></actuator>')
    state_map = replace(StateMap.of_coordinates(NAMES, ("rad", "rad", "rad/s", "rad/s"), (0, 1, 3, 4), num_states=6))
    simulation = replace(
        arm(), spec=lambda: mujoco.MjSpec.from_string(xml), state_map=replace(state_map, hidden=(2, 5))
    )
    action = np.hstack([good.action * [-1.0, 1.0], np.random.default_rng(0).standard_normal((len(good), 1))])
    found = audit(with_action(good, action), simulation)
    assert [finding.words for finding in found.severe if "m1 has the other sign" in finding.words]
    assert not [finding.words for finding in found.findings if "action of m3" in finding.words]


def test_an_angle_that_does_not_tell_where_its_joint_is_is_named_and_no_other_fault():
    """The elbow turns over and over: 3 % of its motion are 3.9 rad, which was taken for an angle in the world."""
    simulation = double_pendulum()
    found = audit(recorded(simulation, 1200, noise=0.03, seed=2), simulation)
    assert not found.severe
    assert any("elbow (4 rad)" in finding.words for finding in found.warnings)


@pytest.mark.parametrize("seed", range(4))
def test_a_short_good_log_has_no_warning(seed, simulation):
    found = audit(recording(seed=seed, rows=70), simulation)
    assert found.severe == found.warnings == ()
