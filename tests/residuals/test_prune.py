"""What several joints have is dropped on all of them or on none; what the rows do not need goes."""

import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import Gravity, JointFrictionLoss
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.prune import prune
from torchrl_h2o.residuals.search import known_set

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
