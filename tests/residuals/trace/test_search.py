"""The search: order of the effects, no effect from noise, elimination, and groups of alternatives."""

import io
from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import (
    ActionBacklash,
    ActionDelay,
    ActionGain,
    Armature,
    BodyInertia,
    BodyMass,
    CatalogueEntry,
    Gravity,
    JointDamping,
    JointFrictionLoss,
    JointSpring,
)
from torchrl_h2o.residuals import Split, trace_effects
from torchrl_h2o.residuals.progress import EFFECTS, OTHERS, STAGES, LoopBar
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.simplify import simplify, simplify_one
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = pendulum()
FACTORS = ({"scale": 0.8}, {"scale": 1.25})
GRAVITY = CatalogueEntry(Gravity(), FACTORS)
GAIN = CatalogueEntry(ActionGain(), FACTORS)
INERTIA = CatalogueEntry(BodyInertia(), FACTORS)
ARMATURE = CatalogueEntry(Armature(), ({"inertia": 0.004}, {"inertia": 0.04}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 0.04}, {"damping": 0.4}))
SPRING = CatalogueEntry(JointSpring(joints="elbow"), ({"stiffness": 0.2}, {"stiffness": 1.0}))
MASS = CatalogueEntry(BodyMass(), FACTORS)
ALL = [GAIN, FRICTION, GRAVITY, DAMPING]


def test_groups_belong_to_the_effects_found():
    """A later round adds effects to those whose alternatives are known; the preliminary result is then without them."""
    problem = Problem.pose(SIMULATION, recorded(SIMULATION.with_effects(Gravity(1.3)), 300))
    state = SearchState.begin(problem, ALL, np.random.default_rng(0))
    one = replace(state.with_found([GRAVITY], state.refitted([GRAVITY], [Gravity(1.2)])), groups=((),))
    assert one.with_found([GRAVITY], one.fit).groups == ((),)
    both = one.refitted([GRAVITY, FRICTION], [Gravity(1.2), JointFrictionLoss(0.01)])
    assert one.with_found([GRAVITY, FRICTION], both).groups == ()


def traced(*truth, catalogue=ALL, rows=1000, noise=0.0, seed=0):
    measured = recorded(SIMULATION.with_effects(*truth), rows, noise=noise, seed=seed)
    return traced_in(measured, catalogue)


def traced_in(measured, catalogue):
    with LoopBar(disable=True) as progress:
        return trace_effects(SIMULATION, measured, catalogue, rng=np.random.default_rng(0), progress=progress)


def names(entries):
    return [entry.name for entry in entries]


@pytest.mark.slow
def test_the_effect_that_explains_most_comes_first():
    trace = traced(Gravity(1.02), JointFrictionLoss(0.1), catalogue=[GRAVITY, FRICTION])
    assert names(trace.entries) == [FRICTION.name, GRAVITY.name]
    assert trace.exact


@pytest.mark.slow
def test_three_effects_are_found_and_no_fourth():
    trace = traced(Gravity(1.2), JointFrictionLoss(0.04), ActionGain(0.8))
    found = {type(effect): effect for effect in trace.fit.effects}
    assert set(found) == {Gravity, JointFrictionLoss, ActionGain}
    assert found[Gravity].scale == pytest.approx(1.2, rel=0.01)
    assert found[JointFrictionLoss].torque == pytest.approx(0.04, rel=0.01)
    assert found[ActionGain].scale == pytest.approx(0.8, rel=0.01)


def test_noise_alone_is_no_effect():
    trace = traced(noise=0.02)
    assert trace.entries == ()
    assert trace.fit.effects == ()
    assert not trace.exact
    assert trace.attempts


@pytest.mark.slow
def test_effects_are_found_under_noise():
    trace = traced(Gravity(1.3), rows=2500, noise=0.01)
    assert names(trace.entries) == [GRAVITY.name]
    assert trace.fit.effects[0].scale == pytest.approx(1.3, rel=0.1)


@pytest.mark.parametrize(
    "truth",
    [
        pytest.param(  # each alone increases the loss as long as the other one is missing
            (Gravity(0.7), JointDamping(0.1)), marks=pytest.mark.slow
        ),
        pytest.param(  # equals a weaker motor, less friction, and negative damping
            (BodyMass(1.3), JointFrictionLoss(0.05)), marks=pytest.mark.slow
        ),
        pytest.param(  # a spring of 0.74 hides most of gravity
            (Gravity(1.2), JointSpring(0.5, joints="elbow"), ActionGain(0.8)), marks=pytest.mark.slow
        ),
    ],
    ids=lambda truth: "-".join(type(effect).__name__ for effect in truth),
)
def test_effects_that_imitate_each_other_are_told_apart(truth):
    trace = traced(*truth, catalogue=[SPRING, *ALL, INERTIA, ARMATURE, MASS])
    found = {type(effect): effect for effect in trace.fit.effects}
    assert set(found) == {type(effect) for effect in truth}
    for effect in truth:
        for name, parameter in effect.parameters.items():
            assert found[type(effect)].parameters[name].value == pytest.approx(parameter.value, rel=1e-3)


@pytest.mark.slow
def test_what_looks_the_same_is_a_group_and_what_does_not_is_none():
    trace = traced(Armature(0.01), catalogue=[GRAVITY, INERTIA, ARMATURE, GAIN])
    ((other,),) = trace.groups
    assert {*names(trace.entries), other.entry.name} == {INERTIA.name, ARMATURE.name}
    armature = next(e for e in (trace.fit.effects[0], other.effect) if isinstance(e, Armature))
    assert armature.inertia == pytest.approx(0.01, rel=0.01)
    assert traced(Gravity(1.3)).groups == ((),)


@pytest.mark.slow
def test_actions_pass_through_effects_in_the_order_that_they_pass_through_in_reality():
    """Delay and backlash do not commute; alone, backlash explains more of the residual than the delay."""
    play, late = ActionBacklash(0.4), ActionDelay(0.013)
    catalogue = [
        CatalogueEntry(ActionBacklash(), ({"width": 0.1}, {"width": 0.5})),
        CatalogueEntry(ActionDelay(), ({"delay": 0.005}, {"delay": 0.02})),
    ]
    for truth in ((late, play), (play, late)):
        trace = traced(*truth, catalogue=catalogue)
        assert [type(effect) for effect in trace.fit.effects] == [type(effect) for effect in truth]
        for found, true in zip(trace.fit.effects, truth, strict=True):
            for name, parameter in true.parameters.items():
                assert found.parameters[name].value == pytest.approx(parameter.value, rel=1e-3)


def test_what_was_as_good_once_makes_way_for_what_is_better_now():
    """An effect that was chosen before another was found is replaced by a better alternative."""
    measured = recorded(SIMULATION.with_effects(Gravity(1.3), JointFrictionLoss(0.03)), 1000)
    catalogue = [DAMPING, FRICTION, GRAVITY]
    state = SearchState.begin(Problem.pose(SIMULATION, measured), catalogue, np.random.default_rng(0))
    known = (Gravity(1.3),)
    leads = screen(state.problem, known, [DAMPING, FRICTION], state.windows.screened)
    damped = state.refitted([GRAVITY, DAMPING], [*known, JointDamping(0.01)])
    state = replace(state.with_found([GRAVITY, DAMPING], damped), rivals={GRAVITY.name: [], DAMPING.name: leads})
    tried = []
    simplified, group = simplify_one(state, 1, lambda: tried.append(1))
    assert len(tried) == 1  # friction; then only rounding is left
    assert simplified.exact
    assert names(simplified.entries) == [GRAVITY.name, FRICTION.name]
    assert simplified.fit.effects[1].torque == pytest.approx(0.03, rel=0.01)
    assert group == ()
    assert simplify(state).groups == ()  # those of gravity depend on friction
    assert simplify(simplified).groups == ((), ())
    assert names(state.entries) == [GRAVITY.name, DAMPING.name]


def test_what_was_tried_is_told_with_its_loss_and_chance():
    trace = traced(Gravity(1.3))
    assert GRAVITY.name not in names(attempt.entry for attempt in trace.attempts)
    assert set(names(attempt.entry for attempt in trace.attempts)) == {GAIN.name, FRICTION.name, DAMPING.name}
    assert all(0.0 <= attempt.p_value <= 1.0 for attempt in trace.attempts)
    losses = [attempt.loss for attempt in trace.attempts]
    assert losses == sorted(losses)


def test_an_effect_that_only_the_fitted_rows_have_is_not_kept():
    """The other rows have no friction, so its fit increases their loss."""
    rough, smooth = (recorded(SIMULATION.with_effects(*e), 1000) for e in ((JointFrictionLoss(0.05),), ()))
    late = (smooth.split != Split.FIT)[:, None]
    changed = {
        name: np.where(late, getattr(smooth, name), getattr(rough, name)) for name in ("observation", "following")
    }
    assert traced_in(replace(rough, **changed), [FRICTION]).entries == ()


def test_the_bar_moves_with_the_search():
    measured = recorded(SIMULATION.with_effects(Gravity(1.3)), 500)
    with LoopBar(file=io.StringIO()) as progress:
        trace_effects(SIMULATION, measured, ALL, rng=np.random.default_rng(0), progress=progress)
        assert STAGES[EFFECTS] < progress.n < STAGES[EFFECTS] + STAGES[OTHERS]
