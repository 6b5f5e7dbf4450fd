"""The table of predictions: the right effects predict best, and a network learns only where something is missing."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from tests.residuals.pendulum import DOUBLE, double_pendulum, pendulum, recorded
from torchrl_h2o.effects import (
    ActionNoise,
    Armature,
    Gravity,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    ObservationDelay,
)
from torchrl_h2o.residuals import Simulation, StateMap
from torchrl_h2o.residuals.judge.prediction_table import (
    BETTER_THAN_GUESS,
    Predicted,
    mean_errors,
    predicted,
    readings_of_joint,
)

SIMULATION, DOUBLE_PENDULUM = pendulum(), double_pendulum()
SLOW_ELBOW = (JointDamping(0.3, "shoulder"), JointDamping(1.0, "elbow"))


def of(truth=(), found=(), simulation=SIMULATION, noise=0.01, rows=3000, seed=0):
    measured = recorded(simulation.with_effects(*truth), rows, noise=noise)
    return predicted(simulation, simulation.with_effects(*found), measured, 10, seed=seed)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_from_an_equal_simulator_nothing_can_be_learnt(noise):
    same = of(noise=noise)
    (total, elbow) = same.table.rows
    assert same.learnt == ()
    assert (total.name, elbow.name) == ("total", "elbow")
    assert total.mended.error < 0.5 * total.velocities_stay.error
    assert total.mended.low <= total.mended.error <= total.mended.high


def test_noise_of_the_actions_cannot_be_learnt():
    assert of((ActionNoise(0.3),)).learnt == ()


def test_the_right_effect_predicts_best_and_leaves_nothing_to_learn():
    right = of((Gravity(1.5),), (Gravity(1.5),))
    (total, _) = right.table.rows
    assert total.mended.high < total.as_it_is.low
    assert right.learnt == ()


def test_a_network_learns_what_the_simulator_lacks():
    missing = of((Gravity(1.5),))
    (words,) = missing.learnt
    (total, _) = missing.table.rows
    assert total.mended_and_network.high < total.mended.low
    assert words.startswith("a small network removes")
    assert words.endswith("200 ms ahead")


def test_what_one_joint_lacks_shows_in_its_row():
    table = of((JointFrictionLoss(0.05, "elbow"),), simulation=DOUBLE_PENDULUM, noise=0.002).table
    errors = {row.name: row.as_it_is.error for row in table.rows}
    assert errors["elbow"] > 1.5 * errors["shoulder"]


def hardly_better(found, noise=0.0, measured=None):
    """The clause about effects that were found in data of a pendulum whose elbow is strongly damped."""
    measured = measured or recorded(DOUBLE_PENDULUM.with_effects(*SLOW_ELBOW), 2000, noise=noise)
    mended = DOUBLE_PENDULUM.with_effects(*found)
    return predicted(DOUBLE_PENDULUM, mended, measured, 20, seed=0).hardly_better(mended, found)


def test_a_heavy_rotor_of_one_joint_is_named_beside_a_right_effect():
    (reason,) = hardly_better((JointDamping(0.3, "shoulder"), Armature(30.0, "elbow")))
    assert reason.startswith("with armature of joints elbow + 30 kg·m², the motion of these joints is predicted hardly")
    assert "200 ms ahead, " in reason


def test_heavy_rotors_of_all_joints_predict_no_motion():
    (reason,) = hardly_better((Armature(30.0),))
    assert reason.startswith("the effects found predict the motion hardly better")


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.05])
def test_right_effects_are_not_named(noise):
    assert hardly_better(SLOW_ELBOW, noise) == ()


def test_an_effect_of_both_joints_is_judged_by_both():
    assert hardly_better((*SLOW_ELBOW, JointForce(1e-6, "*"))) == ()


def test_unknown_readings_of_late_sensors_count_neither_for_nor_against():
    """The velocities at the end of each run are unknown once their delay is undone, here in most windows."""
    runs = replace(recorded(DOUBLE_PENDULUM.with_effects(*SLOW_ELBOW), 2000), run=np.arange(2000) // 30)
    rotors = (JointDamping(0.3, "shoulder"), Armature(30.0, "elbow"), ObservationDelay(0.1, (2, 3)))
    (reason,) = hardly_better(rotors, measured=runs)
    assert "hardly better than by the guess that every velocity stays as it is" in reason


def test_the_mean_error_of_several_readings_is_that_of_the_known_ones():
    error = np.array([[1.0, -3.0, 5.0], [2.0, np.nan, 4.0]])
    known = np.array([[True, True, True], [True, False, True]])
    means = mean_errors(error, known, [[0, 1], [1]])
    np.testing.assert_allclose(means, [[2.0, 2.0], [3.0, 0.0]])


def test_the_readings_of_joints_without_names_and_with_several_coordinates_are_found():
    xml = DOUBLE.replace('name="elbow" ', "").replace('<motor joint="elbow" ctrlrange="-0.3 0.3"/>', "")
    nameless = replace(DOUBLE_PENDULUM, spec=lambda: mujoco.MjSpec.from_string(xml))
    assert readings_of_joint(nameless, 1) == [1, 3]
    body = '<mujoco><worldbody><body><freejoint name="free"/><geom size="0.1"/></body></worldbody></mujoco>'
    every = StateMap.of_coordinates(tuple(map(str, range(13))), ("1",) * 13, range(13), num_states=13)
    assert readings_of_joint(Simulation(lambda: mujoco.MjSpec.from_string(body), 1, every), 0) == list(range(13))


def test_too_few_windows_give_no_table():
    assert of(rows=200) is None


def test_the_same_seed_gives_the_same_and_leaves_the_random_state_alone():
    before = torch.get_rng_state()
    one, same = (of((Gravity(1.5),), seed=3).table for _ in range(2))
    assert one == same
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(("mended", "is_better"), [(0.0165, True), (0.0195, False)])
def test_noise_that_nothing_predicts_does_not_count_against_the_effects(mended, is_better):
    """The guess is wrong by 0.02, and the noise of the readings alone is 0.016."""
    losses = {name: np.full((1, 8), error) for name, error in (("mended", mended), ("velocities_stay", 0.02))}
    both = np.zeros((1, 8)), np.zeros((1, 8))
    one = Predicted(("total",), 0.1, losses, (), both, (both[0][0], both[1][0]), np.array([0.016]))
    assert (one.shares_of_guess[0] < BETTER_THAN_GUESS) == is_better
    assert replace(one, noise=np.zeros(1)).shares_of_guess[0] > BETTER_THAN_GUESS
