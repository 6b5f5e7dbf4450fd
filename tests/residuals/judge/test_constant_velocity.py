"""Effects on single joints that predict their motion no better than the guess that velocities stay as they are."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import DOUBLE, double_pendulum, recorded
from torchrl_h2o.effects import Armature, Gravity, JointDamping, JointForce, ObservationDelay
from torchrl_h2o.residuals import Simulation, Split, StateMap
from torchrl_h2o.residuals.judge.constant_velocity import no_better_than_constant_velocity
from torchrl_h2o.residuals.measured.constant_velocity import errors_ahead, explains_motion, quantities_of_joints

SIMULATION = double_pendulum()
SLOW_ELBOW = (JointDamping(0.3, "shoulder"), JointDamping(1.0, "elbow"))


def against(truth, found, noise=0.0):
    measured = recorded(SIMULATION.with_effects(*truth), 2000, noise=noise)
    return no_better_than_constant_velocity(SIMULATION.with_effects(*found), measured, found)


def test_a_heavy_rotor_of_one_joint_is_named_beside_a_right_effect():
    (reason,) = against(SLOW_ELBOW, (JointDamping(0.3, "shoulder"), Armature(30.0, "elbow")))
    assert reason.startswith("with armature of joints elbow + 30 kg·m², the motion of these joints is predicted hardly")
    assert "elbow 100 ms ahead: " in reason


@pytest.mark.parametrize("noise", [0.0, 0.002, 2.0])
def test_right_effects_are_not_named(noise):
    assert against(SLOW_ELBOW, SLOW_ELBOW, noise=noise) == ()


def test_unknown_readings_of_late_sensors_count_neither_for_nor_against():
    """The velocities at the end of each run are unknown once their delay is undone, here in all windows."""
    late = (*SLOW_ELBOW, ObservationDelay(0.1, (2, 3)))
    runs = replace(recorded(SIMULATION.with_effects(*SLOW_ELBOW), 2000), run=np.arange(2000) // 15)
    (near,) = errors_ahead(SIMULATION.with_effects(*late), runs, Split.REPORT)
    assert np.isnan(near.relative).tolist() == [False, False, True, True]
    assert explains_motion([replace(near, simulated=0.5 * near.guessed)], 0.8)
    assert not explains_motion([replace(near, simulated=0.9 * near.guessed)], 0.8)
    rotors = (JointDamping(0.3, "shoulder"), Armature(30.0, "elbow"), late[-1])
    (reason,) = no_better_than_constant_velocity(SIMULATION.with_effects(*rotors), runs, rotors)
    assert "elbow 100 ms ahead: " in reason


def test_an_effect_of_both_joints_is_judged_by_both():
    found = (*SLOW_ELBOW, JointForce(1e-6, "*"))
    assert against(SLOW_ELBOW, found) == ()


def test_joints_without_names_and_with_several_coordinates_are_found():
    xml = DOUBLE.replace('name="elbow" ', "").replace('<motor joint="elbow" ctrlrange="-0.3 0.3"/>', "")
    nameless = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(xml))
    assert quantities_of_joints(nameless, Armature(0.1, "lower/*")) == [1, 3]
    body = '<mujoco><worldbody><body><freejoint name="free"/><geom size="0.1"/></body></worldbody></mujoco>'
    names = tuple(map(str, range(13)))
    every = StateMap.of_coordinates(names, ("1",) * 13, range(13), num_states=13)
    flying = Simulation(lambda: mujoco.MjSpec.from_string(body), 1, every)
    assert quantities_of_joints(flying, JointForce(0.1, "free")) == list(range(13))
    assert quantities_of_joints(flying, Gravity(0.5)) == []
