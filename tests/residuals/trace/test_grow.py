"""Growing lists of effects: which of several lists is kept."""

from functools import cache

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointFrictionLoss
from torchrl_h2o.residuals.trace.grow import _closest, _simplest_of_best, is_beaten_by
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))


@cache
def lists(friction):
    """Searches in data with gravity × 1.3 and dry friction, in N·m: that found gravity alone, and that found both."""
    measured = recorded(SIMULATION.with_effects(Gravity(1.3), JointFrictionLoss(friction)), 600)
    begun = SearchState.begin(Problem.pose(SIMULATION, measured), [GRAVITY, FRICTION], np.random.default_rng(0))
    gravity = begun.with_found([GRAVITY], begun.refitted([GRAVITY], [Gravity(1.3)]))
    both = begun.refitted([GRAVITY, FRICTION], [Gravity(1.3), JointFrictionLoss(friction)])
    return gravity, begun.with_found([GRAVITY, FRICTION], both)


def found(state):
    return [entry.name for entry in state.entries]


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_lists_the_one_with_a_clearly_lower_loss_is_kept(order):
    gravity, both = lists(friction=0.2)
    assert found(_simplest_of_best([gravity, both][::order])) == found(both)


@pytest.mark.parametrize("order", [1, -1])
def test_a_further_effect_must_contribute_its_share_however_significant_it_is(order):
    gravity, both = lists(friction=5e-4)
    losses = [both.selection_losses(state.fit.effects) for state in (gravity, both)]
    assert both.p_value(*losses) < both.settings.level
    assert found(_simplest_of_best([gravity, both][::order])) == found(gravity)


def test_a_list_is_beaten_by_one_with_a_clearly_lower_loss_alone():
    gravity, both = lists(friction=0.2)
    assert is_beaten_by(gravity, both)
    assert not is_beaten_by(both, gravity)
    gravity, both = lists(friction=5e-4)
    assert not is_beaten_by(gravity, both)


@pytest.mark.parametrize("order", [1, -1])
def test_of_lists_with_nearly_equal_losses_the_one_with_fewer_parameters_is_kept(order):
    """Earlier, one friction for both joints lost to the same friction for each of them, by 0.01 % of the loss."""
    simulation, truth = double_pendulum(), {"torque": 0.08}
    joints, *each = (CatalogueEntry(JointFrictionLoss(joints=which), (truth,)) for which in ("*", "shoulder", "elbow"))
    measured = recorded(simulation.with_effects(JointFrictionLoss(0.08)), 600, noise=0.002, seed=5)
    begun = SearchState.begin(Problem.pose(simulation, measured), [joints, *each], np.random.default_rng(0))
    shared, own = (
        begun.with_found(which, begun.refitted(which, [entry.effect.with_parameters(truth) for entry in which]))
        for which in ([joints], each)
    )
    assert own.selection_losses(own.fit.effects).mean() < own.selection_losses(shared.fit.effects).mean()
    assert [found(state) for state in _closest([shared, own][::order])] == [found(shared)]
