"""What several joints have is dropped on all of them or on none; what the rows do not need goes."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import ActionBias, ActionGain, BodyMass, Gravity, JointDamping, JointForce, JointFrictionLoss
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.prune import prune, replaced
from torchrl_h2o.residuals.search import known_set
from torchrl_h2o.residuals.sweep import Direction, sweep

KINDS = (ActionBias, ActionGain, Gravity, JointDamping, JointForce)
FRICTION = JointFrictionLoss(0.001, "shoulder"), JointFrictionLoss(0.02, "elbow")


@pytest.mark.parametrize(
    ("true", "found", "left"),
    [
        (FRICTION[1:], FRICTION, 2),  # friction of the elbow alone tells that joints have friction
        ((), FRICTION, 0),
        (FRICTION, (*FRICTION, Gravity(1.0001)), 2),
        ((JointFrictionLoss(0.02),), (JointFrictionLoss(0.02), JointFrictionLoss(0.0003, "elbow")), 1),
    ],
    ids=["one of two joints", "none", "another effect", "one on both joints, and one on the elbow"],
)
def test_an_effect_on_several_joints_stays_on_all_or_on_none(true, found, left):
    simulation = double_pendulum()
    measured = recorded(simulation.with_effects(*true), 2000, 0.002)
    ground = Ground.of(simulation, measured, found)
    start = known_set(simulation.catalogue(), found)
    pruned = prune(ground, ground.fitted(start.entries, start.effects))
    assert len(pruned.effects) == left
    assert all(isinstance(effect, JointFrictionLoss) for effect in pruned.effects)


def after_replacing(found, true, kinds):
    """The effects that take the place of those found, of some kinds, in data of a double pendulum."""
    simulation = double_pendulum()
    measured = recorded(simulation.with_effects(true), 2000, 0.002)
    catalogue = [entry for entry in simulation.catalogue() if isinstance(entry.effect, kinds)]
    start = known_set(catalogue, found)
    ground = Ground.of(simulation, measured, start.effects)
    fitted = ground.fitted(start.entries, start.effects)
    directions = sweep(ground.rough(fitted.effects), catalogue, fitted.effects)
    changed, _ = replaced(ground, fitted, directions, lambda: None)
    return changed.effects


def test_the_better_effect_takes_the_place_of_another_and_what_is_idle_then_goes():
    """A constant torque on a joint acts as an offset of its motor's commands, where their limits are not reached."""
    (bias,) = after_replacing((JointForce(0.05, "elbow"), Gravity(1.0001)), ActionBias(0.05, (1,)), KINDS)
    assert isinstance(bias, ActionBias)
    assert bias.bias == pytest.approx(0.05, rel=0.05)


def test_one_effect_takes_the_place_of_the_same_effect_on_two_motors():
    """Two weak motors hardly lift what a heavy link weighs."""
    motors = ActionGain(0.85, (0,)), ActionGain(0.8, (1,))
    (mass,) = after_replacing(motors, BodyMass(1.3, "lower"), (ActionGain, BodyMass))
    assert isinstance(mass, BodyMass)
    assert mass.scale == pytest.approx(1.3, rel=0.05)


@pytest.mark.parametrize(("worse_by", "takes_the_place"), [(0.0, True), (0.5, True), (1.0, False)])
def test_a_usual_effect_takes_the_place_of_an_unusual_one_that_explains_hardly_more(
    worse_by, takes_the_place, monkeypatch
):
    """Gravity needs 4 nats for being unusual. At 0.5 nats a block, the evidence for it is more than 3 nats."""
    simulation = double_pendulum()
    catalogue = [entry for entry in simulation.catalogue() if isinstance(entry.effect, Gravity | JointDamping)]
    damping, gravity = (known_set(catalogue, (effect,)) for effect in (JointDamping(0.01), Gravity(0.9)))
    ground = Ground.of(simulation, recorded(simulation.with_effects(JointDamping(0.01)), 400))
    scatter = np.random.default_rng(0).standard_normal(40)
    scatter -= scatter.mean()
    damping = replace(damping, scores=np.zeros(40))
    gravity = replace(gravity, scores=scatter + worse_by)
    none = replace(ground.found((), ()), scores=np.full(40, -9.0))
    sets = {one.names: one for one in (damping, gravity, none)}
    monkeypatch.setattr(Ground, "fitted", lambda self, entries, effects: sets[frozenset(one.name for one in entries)])
    monkeypatch.setattr(Ground, "found", Ground.fitted)
    monkeypatch.setattr("torchrl_h2o.residuals.prune.Candidates.of", lambda *args: None)
    monkeypatch.setattr("torchrl_h2o.residuals.prune.with_one_more", lambda *args, **options: [damping])
    monkeypatch.setattr("torchrl_h2o.residuals.prune.prune", lambda ground, found: found)
    assert replaced(ground, gravity, [], lambda: None)[0] is (damping if takes_the_place else gravity)


def test_an_effect_that_is_on_the_wrong_joint_beside_another_wrong_one_is_put_on_the_right_one(monkeypatch):
    """Neither alone has a better one in its place. Beside what explains as much as the first, the second has."""
    simulation = double_pendulum()
    gain, mass = ActionGain(0.9), BodyMass(1.1)
    one_joint, other_joint = JointDamping(0.01, "shoulder"), JointDamping(0.01, "elbow")
    totals = {(gain, one_joint): 0.0, (mass, one_joint): 0.0, (mass, other_joint): 1.0, (gain, other_joint): -5.0}
    totals |= {(effect,): -9.0 for effect in (gain, mass, one_joint, other_joint)}
    scatter = np.random.default_rng(0).standard_normal(40)
    scatter -= scatter.mean()
    sets = [
        replace(known_set(simulation.catalogue(), effects), scores=score + scatter * (score == 0.0))
        for effects, score in totals.items()
    ]
    by_names = {one.names: one for one in sets}
    start, right = sets[0], sets[2]

    def beside(ground, fewer, instead_of, pairs=False):
        return [] if pairs else [one for one in sets[:4] if fewer.names < one.names and one.names != instead_of.names]

    monkeypatch.setattr(Ground, "found", lambda _, entries, effects: by_names[frozenset(one.name for one in entries)])
    monkeypatch.setattr(Ground, "fitted", Ground.found)
    monkeypatch.setattr("torchrl_h2o.residuals.prune.Candidates.of", lambda _, fewer, __: fewer)
    monkeypatch.setattr("torchrl_h2o.residuals.prune.with_one_more", beside)
    monkeypatch.setattr("torchrl_h2o.residuals.prune.prune", lambda _, found: found)
    ground = Ground.of(simulation, recorded(simulation.with_effects(gain), 400))
    directions = [Direction(entry, {}, np.zeros(0)) for entry in simulation.catalogue()]
    found, alike = replaced(ground, start, directions, lambda: None)
    assert found is right
    assert alike == [[], []]
