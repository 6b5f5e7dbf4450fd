"""A search that begins with known effects, or anew: without noise, or in longer windows."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, Gravity, JointDamping, JointFrictionLoss, ObservationGain
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar, OutOfTimeError
from torchrl_h2o.residuals.trace.begin import begin_in_longer_windows, begin_noise_free, begin_with
from torchrl_h2o.residuals.trace.choose_horizon import longer_windows
from torchrl_h2o.residuals.trace.fit import Fit
from torchrl_h2o.residuals.trace.grow import grow
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.search import _from_another_beginning, _outcome
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = pendulum()
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8}, {"scale": 1.25}))
FRICTION = CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1}))
GAIN = CatalogueEntry(ObservationGain(entries=(1,)), ({"scale": 0.8}, {"scale": 1.25}))
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
    assert list(dict.fromkeys(map(len, seen))) == [1, 2]  # at the beginning, and with the missing one


@pytest.mark.slow
def test_every_addition_is_reported():
    found, seen = traced([])
    assert found.keys() == {Gravity, JointFrictionLoss}
    assert len(seen[-1]) == 2


@pytest.mark.slow
def test_a_known_effect_that_is_not_needed_or_not_in_the_catalogue_does_not_stay():
    found, _ = traced([JointDamping(0.1), JointFrictionLoss(0.01)])
    assert found.keys() == {Gravity, JointFrictionLoss}


@pytest.mark.parametrize(("gain", "noise", "begins"), [(1.3, 0.0, True), (1.0, 0.01, False), (1.3, 0.05, False)])
def test_a_gain_that_was_taken_for_noise_is_found_by_a_search_without_noise(gain, noise, begins):
    state = with_gravity_found(gain, noise)
    other = begin_noise_free(state, [GRAVITY, GAIN], np.random.default_rng(0), LoopBar(disable=True))
    assert (other is not None) is begins
    if other is not None:
        grown = grow(other, np.random.default_rng(0), LoopBar(disable=True))
        assert grown.exact
        assert grown.problem.horizon == 1
        assert {type(effect): effect.scale for effect in grown.fit.effects} == pytest.approx(
            {Gravity: 1.3, ObservationGain: gain}, rel=1e-4
        )


def from_another_beginning(state, catalogue):
    seen = []
    with LoopBar(disable=True) as bar:
        return _from_another_beginning(state, catalogue, np.random.default_rng(0), bar, seen.append), seen


@pytest.mark.slow
def test_a_search_without_noise_counts_if_it_explains_everything():
    state = with_gravity_found(1.3, 0.0)
    after, seen = from_another_beginning(state, [GRAVITY, GAIN])
    assert after.exact
    assert seen == [after]


@pytest.mark.slow
def test_where_it_does_not_longer_windows_show_the_gain_beside_damping_that_the_catalogue_lacks():
    state = with_gravity_found(1.3, 0.0, JointDamping(0.1))
    after, seen = from_another_beginning(state, [GRAVITY, GAIN])
    assert seen[-1] == after
    assert not after.exact
    assert {one.problem.horizon for one in seen} == {10}
    assert {one.chosen_horizon for one in seen} == {state.problem.horizon} == {5}
    assert {type(effect) for effect in after.fit.effects} == {Gravity, ObservationGain}


@pytest.mark.slow
def test_the_first_search_stays_where_the_one_in_longer_windows_explains_less(monkeypatch):
    state = with_gravity_found(1.3, 0.0, JointDamping(0.1))
    first = {entry.name for entry in state.entries}

    def beaten(one, other):
        return {entry.name for entry in one.entries} != first

    monkeypatch.setattr("torchrl_h2o.residuals.trace.search.is_beaten_by", beaten)
    after, seen = from_another_beginning(state, [GRAVITY, GAIN])
    assert after is state
    assert not seen


def test_a_better_list_in_longer_windows_is_kept_if_the_time_ends_before_the_search_does():
    state = with_gravity_found(1.3, 0.0, JointDamping(0.1))
    kept = []

    def keep(better):
        kept.append(better)
        raise OutOfTimeError("looking for effects")

    with LoopBar(disable=True) as bar, pytest.raises(OutOfTimeError):
        _from_another_beginning(state, [GRAVITY, GAIN], np.random.default_rng(0), bar, keep)
    assert {type(effect) for effect in kept[0].fit.effects} == {Gravity, ObservationGain}
    assert kept[0].chosen_horizon == state.problem.horizon


@pytest.mark.slow
def test_a_search_in_longer_windows_that_finds_the_same_effects_does_not_count():
    state = with_gravity_found(1.0, 0.01)
    assert longer_windows(state.problem) == 10
    after, seen = from_another_beginning(state, [GRAVITY])
    assert after is state
    assert not seen


def test_a_search_begins_with_effects_of_which_the_model_rejects_some_without_the_others():
    """The joint has damping of 0.1, so -0.08 twice needs the + 0.1 of the third effect."""
    known = [JointDamping(size, joints) for size, joints in ((0.1, "elbow"), (-0.08, "*"), (-0.08, "elb*"))]
    entries = [CatalogueEntry(JointDamping(joints=one.joints), ({"damping": 0.01},)) for one in known]
    measured = recorded(SIMULATION.with_effects(JointDamping(-0.06)), 600)
    state = SearchState.begin(Problem.pose(SIMULATION, measured), entries, np.random.default_rng(0))
    assert len(begin_with(state, known).entries) == len(known)


@pytest.mark.parametrize("why", ["nothing was found", "only rounding is left", "the windows are as long"])
def test_a_search_in_longer_windows_does_not_begin_if(why):
    state = with_gravity_found(1.0, 0.01)
    if why == "nothing was found":
        state = state.with_found((), Fit((), (), 1.0, ()))
    elif why == "only rounding is left":
        state = replace(state, exact=True)
    else:
        state = replace(state, problem=replace(state.problem, horizon=10))
    with LoopBar(disable=True) as bar:
        assert begin_in_longer_windows(state, [GRAVITY], np.random.default_rng(0), bar) is None


def test_the_outcome_has_the_window_length_that_was_chosen_for_the_data():
    state = with_gravity_found(1.0, 0.01)
    assert (_outcome(state).horizon, _outcome(state).others) == (5, ())
    assert _outcome(replace(state, chosen_horizon=1)).horizon == 1


def test_estimated_velocities_have_noise():
    state = with_gravity_found(1.3, 0.0)
    measured = replace(state.problem.measured, estimated_std=np.array([0.0, 0.01]))
    state = replace(state, problem=replace(state.problem, measured=measured))
    assert begin_noise_free(state, [GRAVITY, GAIN], np.random.default_rng(0), LoopBar(disable=True)) is None


def with_gravity_found(gain, noise, *also):
    """A search that has found gravity, and takes the rest for noise of the velocity's sensor."""
    measured = recorded(SIMULATION.with_effects(Gravity(1.3), *also), noise=noise)
    scale = np.array([1.0, gain])
    measured = replace(measured, observation=scale * measured.observation, following=scale * measured.following)
    found = Gravity(1.25)
    sensor_std = np.array([0.0, 0.1]) * measured.observation.std(0)
    state = SearchState.begin(Problem.pose(SIMULATION, measured, 5), [GRAVITY, GAIN], np.random.default_rng(0))
    state = state.with_found([GRAVITY], Fit((found,), (("scale",),), 1.0, ({},)))
    return state.rescaled(Problem.pose(SIMULATION.with_effects(found), measured, 5, sensor_std=sensor_std))
