"""The score prefers the right effects, and a search by it finds them."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import Armature, CatalogueEntry, Gravity, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.score import Difference
from torchrl_h2o.residuals.search import Ground, trace_effects

TRUTH = JointFrictionLoss(0.1)
CATALOGUE = (
    CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25})),
    CatalogueEntry(JointFrictionLoss(), ({"torque": 0.02}, {"torque": 0.2})),
    CatalogueEntry(JointDamping(), ({"damping": 0.02}, {"damping": 0.2})),
    CatalogueEntry(Armature(), ({"inertia": 0.01}, {"inertia": 0.1})),
)


@pytest.fixture(scope="module", params=[0.0, 0.01], ids=["exact", "noisy"])
def measured(request):
    return recorded(pendulum().with_effects(TRUTH), 2000, request.param)


def difference(measured, better, worse):
    ground = Ground.of(pendulum(), measured, better)
    return Difference(ground.model.scores(better) - ground.model.scores(worse))


@pytest.mark.parametrize(
    "wrong", [(), (JointDamping(0.1),), (Gravity(1.1),), (JointFrictionLoss(0.15),), (Armature(0.05),)]
)
def test_the_true_effect_predicts_better_than_a_wrong_one(measured, wrong):
    assert difference(measured, (TRUTH,), wrong).evidence > 10.0


def test_an_effect_too_many_predicts_no_better(measured):
    more = difference(measured, (TRUTH, Gravity(1.02)), (TRUTH,))
    assert more.evidence < 4.6


def test_a_search_finds_the_true_effect_alone(measured):
    with LoopBar(disable=True) as bar:
        trace = trace_effects(pendulum(), measured, CATALOGUE, rng=np.random.default_rng(0), progress=bar)
    (effect,) = trace.fit.effects
    assert isinstance(effect, JointFrictionLoss)
    assert effect.torque == pytest.approx(TRUTH.torque, rel=0.1)


def test_rare_differences_count_as_evidence_but_common_noise_does_not():
    rare, noise = np.zeros(40), np.random.default_rng(0).standard_normal(40)
    rare[:6] = (2.0, 3.0, 2.5, 2.0, 3.0, 2.0)
    assert Difference(rare).evidence > 4.6
    assert abs(Difference(noise).evidence) < 4.6
