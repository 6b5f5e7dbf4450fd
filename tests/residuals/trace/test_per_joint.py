"""One value for all joints against one value each: decided by the data."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import ActionGain, Armature, CatalogueEntry, JointFrictionLoss
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.trace.per_joint import divide_by_element, divided_where_shared_harms
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = double_pendulum()
TRIALS = ({"torque": 0.02}, {"torque": 0.1})
ALL, SHOULDER, ELBOW = (CatalogueEntry(JointFrictionLoss(joints=j), TRIALS) for j in ("*", "shoulder", "elbow"))
CATALOGUE = (SHOULDER, ELBOW, ALL)


def friction(shoulder, elbow, noise):
    truth = (JointFrictionLoss(shoulder, "shoulder"), JointFrictionLoss(elbow, "elbow"))
    measured = recorded(SIMULATION.with_effects(*truth), 3000, noise=noise)
    with LoopBar(disable=True) as progress:
        trace = trace_effects(SIMULATION, measured, CATALOGUE, rng=np.random.default_rng(0), progress=progress)
    return trace.fit.effects


def torques(effects):
    """Friction added to each joint, by all effects together."""
    model = SIMULATION.with_effects(*effects).model
    return [float(model.dof_frictionloss[model.joint(joint).dofadr[0]]) for joint in ("shoulder", "elbow")]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_joints_that_differ_have_a_value_each(noise):
    assert torques(friction(0.15, 0.03, noise)) == pytest.approx([0.15, 0.03], rel=0.1)


@pytest.mark.slow
def test_longer_windows_show_a_difference_that_noise_hides_in_short_ones():
    """With windows of one step alone, both joints had 0.065 N·m."""
    effects = friction(0.08, 0.06, 0.01)
    assert [effect.joints for effect in effects] == ["shoulder", "elbow"]
    assert torques(effects) == pytest.approx([0.08, 0.06], rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_joints_that_are_equal_share_a_value(noise):
    effects = friction(0.08, 0.08, noise)
    assert [effect.joints for effect in effects] == ["*"]
    assert torques(effects) == pytest.approx([0.08, 0.08], rel=0.05)


def each_its_own(found, catalogue):
    """The effects found, by the division of those on several elements, in data of which they are the truth."""
    rng = np.random.default_rng(0)
    entries = [entry for entry, _ in found]
    effects = [entry.effect.with_parameters(values) for entry, values in found]
    measured = recorded(SIMULATION.with_effects(*effects), 600, noise=0.002)
    begun = SearchState.begin(Problem.pose(SIMULATION, measured), catalogue, rng)
    state = replace(begun.with_found(entries, begun.refitted(entries, effects)), rivals={e.name: [] for e in entries})
    return divide_by_element(state.rescaled(state.posed_at(state.fit.effects)), rng).fit.effects


def test_an_effect_on_all_joints_and_more_on_one_become_one_effect_on_each():
    """Earlier, an effect on all joints was not divided beside one on a single joint."""
    effects = each_its_own([(ALL, {"torque": 0.03}), (SHOULDER, {"torque": 0.12})], CATALOGUE)
    assert [effect.joints for effect in effects] == ["shoulder", "elbow"]
    assert [effect.torque for effect in effects] == pytest.approx([0.15, 0.03], rel=0.05)


def shared(truth, torque):
    """A state with one friction on both joints, of which it has added a given torque, in data with other frictions."""
    rng = np.random.default_rng(0)
    measured = recorded(SIMULATION.with_effects(*truth), 600, noise=0.002)
    begun = SearchState.begin(Problem.pose(SIMULATION, measured), CATALOGUE, rng)
    fitted = begun.refitted([ALL], [JointFrictionLoss(torque)])
    return replace(
        begun.with_found([ALL], replace(fitted, effects=(JointFrictionLoss(torque),))), rivals={ALL.name: []}
    )


def test_an_effect_on_all_joints_that_makes_one_worse_is_put_in_for_each_joint():
    state = divided_where_shared_harms(shared([JointFrictionLoss(0.15, "shoulder")], 0.1))
    assert [effect.joints for effect in state.fit.effects] == ["shoulder", "elbow"]
    assert torques(state.fit.effects) == pytest.approx([0.15, 0.0], abs=0.01)


def test_an_effect_on_all_joints_that_helps_each_of_them_stays():
    state = shared([JointFrictionLoss(0.1)], 0.1)
    assert divided_where_shared_harms(state) is state


def test_factors_of_all_motors_and_of_one_are_multiplied():
    trials = ({"scale": 0.8}, {"scale": 1.25})
    both, first, second = (CatalogueEntry(ActionGain(actuators=which), trials) for which in (None, (0,), (1,)))
    effects = each_its_own([(first, {"scale": 0.9}), (both, {"scale": 0.8})], (both, first, second))
    assert [effect.actuators for effect in effects] == [(0,), (1,)]
    assert [effect.scale for effect in effects] == pytest.approx([0.72, 0.8], rel=0.02)


@pytest.mark.slow
def test_an_effect_that_is_only_possible_beside_another_does_not_end_the_search():
    """Together they are 0.012 at the shoulder and 0.009 kg·m² at the elbow; alone, the second would be negative."""
    truth = (Armature(0.012, "shoulder"), Armature(0.009, "elbow"))
    measured = recorded(SIMULATION.with_effects(*truth), 1500, noise=0.002)
    trials = ({"inertia": 0.005}, {"inertia": -0.003})
    catalogue = [CatalogueEntry(Armature(joints=joints), trials) for joints in ("*", "shoulder", "elbow")]
    known = (Armature(-0.003, "elbow"), Armature(0.012, "*"))
    with LoopBar(disable=True) as progress:
        rng = np.random.default_rng(0)
        trace = trace_effects(SIMULATION, measured, catalogue, known=known, rng=rng, progress=progress)
    model = SIMULATION.with_effects(*trace.fit.effects).model
    assert model.dof_armature == pytest.approx([0.012, 0.009], rel=0.15)
