"""Angles of links in the world, where the model counts from the parent link, and reversed angles."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.data.audit.recorded import recording
from torchrl_h2o.data.audit import audit
from torchrl_h2o.data.audit.columns import absolute_angles
from torchrl_h2o.data.audit.log import Log, Pair
from torchrl_h2o.effects import ActionGain, Armature, BodyMass, JointFrictionLoss

JOINT = '<joint axis="0 1 0"/><geom size="0.02"/>'
CHAIN = f"<mujoco><worldbody><body>{JOINT}<body>{JOINT}<body>{JOINT}</body></body></body></worldbody></mujoco>"


def in_the_world(log):
    """The same recording with the elbow's angle and velocity as sums with those of the shoulder."""
    changed = [rows.copy() for rows in (log.observation, log.following)]
    for rows in changed:
        rows[:, [1, 3]] += rows[:, [0, 2]]
    return replace(log, observation=changed[0], following=changed[1])


def words_of(log, simulation):
    return [finding.words for finding in audit(log, simulation).findings if "the link in the world" in finding.words]


def test_an_elbow_whose_angle_is_counted_from_the_world_is_found(good, simulation):
    (finding,) = [one for one in audit(in_the_world(good), simulation).severe if one.check == "model"]
    assert "elbow and its velocity are counted from the parent link" in finding.words
    assert "in the world, which also contains shoulder" in finding.words


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param((ActionGain(1.5), Armature(0.002)), marks=pytest.mark.slow),
        (BodyMass(2.2), JointFrictionLoss(0.05)),
    ],
)
def test_it_is_found_beside_effects_that_the_simulator_lacks(effects, simulation):
    log = recording(*effects)
    assert words_of(log, simulation) == []
    assert len(words_of(in_the_world(log), simulation)) == 1


def test_it_is_not_said_where_the_simulator_lacks_too_much_to_tell(simulation):
    """Beside such a rotor, the world's angles fit 14 times better, though those of the log are relative."""
    log = recording(Armature(0.051), JointFrictionLoss(0.31), BodyMass(2.5), ActionGain(0.6))
    assert words_of(log, simulation) == []


def test_only_joints_with_a_parallel_joint_above_are_concerned(good, simulation):
    pairs = Log.of(good, simulation).pairs
    ((change, words),) = absolute_angles(pairs, simulation.model)
    assert words.startswith("elbow")
    assert change(in_the_world(good).observation) == pytest.approx(good.observation)
    crossed = replace(simulation, spec=lambda: _with_crossed_elbow(simulation))
    assert list(absolute_angles(pairs, crossed.model)) == []


def _with_crossed_elbow(simulation):
    spec = simulation.spec()
    spec.joint("elbow").axis = [1, 0, 0]
    return spec


def test_a_reversed_joint_is_found_where_the_simulator_lacks_friction_and_gain(simulation):
    """The simulator's error alone does not tell it."""
    log = recording(BodyMass(2.2), JointFrictionLoss(0.05), ActionGain(1.3))
    changed = [rows * np.array([1.0, -1.0, 1.0, -1.0]) for rows in (log.observation, log.following)]
    found = audit(replace(log, observation=changed[0], following=changed[1]), simulation)
    assert "elbow and its velocity are reversed" in found.severe[0].words
    assert audit(log, simulation).severe == ()


def test_of_three_links_the_last_angle_in_the_world_contains_both_others():
    model = mujoco.MjModel.from_xml_string(CHAIN)
    pairs = tuple(Pair(f"j{i}", f"v{i}", i, 3 + i, i, i, angle=True) for i in range(3))
    found = {words: change for change, words in absolute_angles(pairs, model)}
    last = next(change for words, change in found.items() if words.startswith("j2"))
    relative = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    assert last(np.array([0.1, 0.2, 0.6, 1.0, 2.0, 6.0])) == pytest.approx(relative)
    every = next(change for words, change in found.items() if words.startswith("j1, j2"))
    assert every(np.array([0.1, 0.3, 0.6, 1.0, 3.0, 6.0])) == pytest.approx(relative)
