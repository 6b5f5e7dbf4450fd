"""A search that begins with known effects, such as those of an unfinished run."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointDamping, JointFrictionLoss
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))
TRUTH = (Gravity(1.3), JointFrictionLoss(0.05))


def traced(known):
    seen = []
    measured = recorded(SIMULATION.with_effects(*TRUTH), 1000)
    with LoopBar(disable=True) as progress:
        trace = trace_effects(
            SIMULATION,
            measured,
            [GRAVITY, FRICTION],
            rng=np.random.default_rng(0),
            progress=progress,
            known=known,
            found=lambda trace: seen.append(trace.fit.effects),
        )
    return {type(effect): effect for effect in trace.fit.effects}, seen


def test_known_effects_are_fitted_again_and_the_missing_one_is_added():
    found, seen = traced([Gravity(1.1)])
    assert found[Gravity].scale == pytest.approx(1.3, rel=1e-3)
    assert found[JointFrictionLoss].torque == pytest.approx(0.05, rel=1e-2)
    assert [len(effects) for effects in seen] == [1, 2]  # at the beginning, and with the missing one


def test_every_addition_is_reported():
    found, seen = traced([])
    assert found.keys() == {Gravity, JointFrictionLoss}
    assert len(seen[-1]) == 2


def test_a_known_effect_that_is_not_needed_or_not_in_the_catalogue_does_not_stay():
    found, _ = traced([JointDamping(0.1), JointFrictionLoss(0.01)])
    assert found.keys() == {Gravity, JointFrictionLoss}
