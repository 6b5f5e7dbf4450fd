"""The score prefers the right effects, and a search by it finds them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv

from tests.residuals.pendulum import UnknownForce, double_pendulum, pendulum, recorded
from torchrl_h2o.effects import (
    Armature,
    CatalogueEntry,
    GearPlay,
    Gravity,
    JointDamping,
    JointFrictionLoss,
    ObservationBias,
    ObservationDelay,
    ObservationGain,
)
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.likelihood import Difference
from torchrl_h2o.residuals import Measured, Simulation, Split, StateMap, start_states
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.refit import fit_set, slopes_of, variables_of
from torchrl_h2o.residuals.score import Model, Predictions
from torchrl_h2o.residuals.search import search
from torchrl_h2o.residuals.start_states import Noise

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
    return Difference(ground.model(better).scores() - ground.model(worse).scores())


@pytest.mark.parametrize(
    "wrong", [(), (JointDamping(0.1),), (Gravity(1.1),), (JointFrictionLoss(0.15),), (Armature(0.05),)]
)
def test_the_true_effect_predicts_better_than_a_wrong_one(measured, wrong):
    assert difference(measured, (TRUTH,), wrong).evidence > 10.0


def test_what_is_right_predicts_better_where_all_errors_are_larger():
    """The rows for selection are faster than those for fits, so that an undeclared drag matters more there."""
    real = pendulum().with_effects(TRUTH, UnknownForce(1.0, law=lambda q, v, t: -0.05 * v**3))
    slow = recorded(pendulum(), 2000)
    action = np.where(slow.split[:, None] == Split.FIT, 0.3 * slow.action, slow.action)
    path = np.vstack([np.zeros(2), real.rollout(np.zeros((1, 2)), action[None])[0]])
    measured = replace(slow, observation=path[:-1], action=action, following=path[1:])
    ground = Ground.of(pendulum(), measured)
    right, none = ground.fitted(CATALOGUE[1:2], (TRUTH,)), ground.found((), ())
    assert Difference((right.scores - none.scores)[ground.num_fit :]).evidence > 5.0


def test_noise_of_the_commands_is_white_one_step_ahead_and_missing_gravity_is_not():
    measured, simulation = recorded(pendulum(), 2000, 1e-4), pendulum()
    noise = 0.3 * measured.action.std(0) * np.random.default_rng(1).standard_normal(measured.action.shape)
    noisy = Model.of(simulation, replace(measured, action=measured.action + noise))
    blocks = len(noisy.fit.blocks) + len(noisy.selection.blocks)
    assert noisy.one_step_ahead()[0].shape == noisy.scores().shape == (blocks,)
    assert noisy.one_step_ahead()[1]
    assert not noisy.one_step_ahead((Gravity(2.0),))[1]


def test_a_fit_that_is_given_derivatives_reaches_the_same_values_by_fewer_simulations(measured, monkeypatch):
    part, effects, entries = Model.of(pendulum(), measured).fit, (JointFrictionLoss(0.07),), (CATALOGUE[1],)
    slopes = slopes_of([part], effects, variables_of(part, entries, effects), [part.errors(effects)])
    simulated, errors = [], Predictions.errors
    monkeypatch.setattr(Predictions, "errors", lambda self, with_: simulated.append(with_) or errors(self, with_))
    (given,) = fit_set([part], entries, effects, most_steps=8, slopes=slopes).effects
    fewer, simulated[:] = len(simulated), []
    (computed,) = fit_set([part], entries, effects, most_steps=8).effects
    assert given.torque == pytest.approx(computed.torque, rel=0.01)
    assert fewer < len(simulated)


def test_a_smooth_sensor_has_little_noise_however_wrong_the_simulator_is():
    env = TransformedEnv(GymEnv("Hopper-v5"), DynamicsGap(ObservationGain(1.36, (4,))))
    torch.manual_seed(0)
    env.set_seed(0)
    data, simulation = env.rollout(500, break_when_any_done=False), Simulation.from_env(GymEnv("Hopper-v5"))
    assert Model.of(simulation, Measured.from_ted(data, simulation)).fit.starts.noise.sensor[4] < 0.04


def test_sensors_that_are_late_at_the_end_of_runs_leave_the_score_finite():
    simulation = double_pendulum().with_effects(ObservationDelay(0.02, (2, 3)))
    runs = replace(recorded(simulation, 1200), run=np.arange(1200) // 96)
    ground = Ground.of(simulation, runs)
    assert np.isfinite(ground.base.scores()).all()
    assert np.isfinite(ground.base.fit.floor).all()


def test_sets_are_compared_with_the_same_noise_so_that_an_effect_of_no_size_gains_nothing():
    ground = Ground.of(double_pendulum(), recorded(double_pendulum(), 1200, 0.01))
    gain = Difference(ground.model((Gravity(1.0 + 1e-9),)).scores() - ground.base.scores())
    assert np.abs(gain.by_block).max() < 1e-4


def test_noise_is_not_taken_for_an_error_of_the_simulator_because_steps_are_linearised_about_filtered_states(
    monkeypatch,
):
    measured = recorded(double_pendulum(), 1200, 0.01)
    twice = Model.of(double_pendulum(), measured)
    monkeypatch.setattr(start_states, "LINEARISED", 1)
    once = Model.of(double_pendulum(), measured)
    assert twice.scores().mean() > once.scores().mean() + 0.3
    assert (twice.fit.starts.noise.step < 0.5 * once.fit.starts.noise.step).all()


def test_readings_that_surprise_leave_the_doubt_of_a_coordinate_that_is_simulated_and_not_measured():
    """The depth of a contact must not explain what a wrong set of effects leaves."""
    simulation = Simulation.from_env(WheelLeggedEnv())
    data = record(WheelLeggedEnv(), noisy_balance_controller(), 500, seed=0, progress=False)
    doubts = []
    for error in (0.0, 0.05):
        measured = Measured.from_ted(data, simulation)
        measured.observation[5:300:10, 1] += error
        measured.following[4:299:10, 1] += error
        starts = Model.of(simulation, measured, Noise(np.full(4, 1e-6), np.full(7, 1e-4))).fit.starts
        doubts.append(np.einsum("brii->bri", starts.covariance)[..., starts.record.settled].max())
    assert doubts[1] == pytest.approx(doubts[0], rel=0.1)


def test_the_velocity_of_a_measured_position_is_filtered_and_not_simulated():
    simulation = double_pendulum()
    positions = replace(StateMap.of_coordinates(("shoulder", "elbow"), ("rad", "rad"), (0, 1), 4), hidden=(2, 3))
    whole = recorded(simulation, 300, 1e-4)
    measured = replace(whole, observation=whole.observation[:, :2], following=whole.following[:, :2])
    record = Model.of(replace(simulation, state_map=positions), measured).fit.record
    assert record.positions_of_velocities == {2: 0, 3: 1}
    assert not record.settled.any()
    rates = record.states[0][:, 2:]
    assert np.abs(rates - whole.observation[:, 2:]).mean() < 0.1 * whole.observation[:, 2:].std()


def test_an_effect_too_many_predicts_no_better(measured):
    more = difference(measured, (TRUTH, Gravity(1.02)), (TRUTH,))
    assert np.isfinite(more.by_block).all()
    assert more.evidence < 4.6


def test_a_search_finds_the_true_effect_alone_with_an_interval_that_holds_it(measured):
    found = []
    with LoopBar(disable=True) as bar:
        explained = search(pendulum(), measured, CATALOGUE, progress=bar, so_far=found.append)
    (part,) = explained.parts
    assert isinstance(part.effect, JointFrictionLoss)
    assert part.effect.torque == pytest.approx(TRUTH.torque, rel=0.1)
    low, high = part.ci95["torque"]
    assert low - 1e-4 < TRUTH.torque < high + 1e-4
    assert [type(effect) for effect in found[-1].effects] == [JointFrictionLoss]


def test_a_search_adds_nothing_where_nothing_is_missing():
    data = recorded(pendulum(), 2000, 0.01)
    with LoopBar(disable=True) as bar:
        assert search(pendulum(), data, CATALOGUE, progress=bar).effects == ()


def test_a_score_that_is_no_number_is_no_evidence_of_likeness():
    assert np.isnan(Difference(np.full(10, np.nan)).evidence)


def test_windows_begin_with_the_teeth_of_a_gear_where_the_log_has_brought_them():
    simulation, play = pendulum(), GearPlay(0.3)
    data = recorded(simulation.with_effects(play), 1000)
    in_simulator = Model.of(simulation.with_effects(play), data).fit
    added = Ground.of(simulation, data, (play,)).fit_part((play,))
    predicted = added.errors(), added.errors((play,)), in_simulator.errors()
    far = [np.mean(np.abs(errors[-1]) > 0.05) for errors in predicted]
    assert far[0] > 0.2
    assert max(far[1:]) < 0.1 * far[0]


@pytest.mark.parametrize("effect", [ObservationBias(0.1, (0,)), Gravity(1.2)], ids=["sensor", "gravity"])
@pytest.mark.parametrize("system", ["pendulum", "robot"])
def test_effects_that_are_added_predict_as_the_simulator_with_them(system, effect):
    if system == "pendulum":
        simulation, data = pendulum(), recorded(pendulum(), 1000, 0.01)
    else:  # it sinks into the floor, which is not observed
        simulation = Simulation.from_env(WheelLeggedEnv())
        ted = record(WheelLeggedEnv(), noisy_balance_controller(), 1000, seed=0, progress=False)
        data = Measured.from_ted(ted, simulation)
    added = Ground.of(simulation, data, (effect,)).fit_part((effect,)).errors((effect,))
    in_simulator = Model.of(simulation.with_effects(effect), data).fit.errors()
    for one, other in zip(added, in_simulator, strict=True):
        assert one == pytest.approx(other, abs=1e-9)


def test_the_score_does_not_depend_on_the_gain_of_a_sensor():
    """Otherwise a larger gain would make errors smaller, and so raise the score of any data."""
    plain = recorded(pendulum(), 1500, 0.01)
    doubled = replace(plain, observation=2.0 * plain.observation, following=2.0 * plain.following)
    score = Model.of(pendulum(), plain).scores().mean()
    gains = pendulum().with_effects(ObservationGain(2.0))
    assert Model.of(gains, doubled).scores().mean() == pytest.approx(score, abs=0.02)


def test_rare_differences_count_as_evidence_but_common_noise_does_not():
    rare, noise = np.zeros(40), np.random.default_rng(0).standard_normal(40)
    rare[:6] = (2.0, 3.0, 2.5, 2.0, 3.0, 2.0)
    assert Difference(rare).evidence > 4.6
    assert abs(Difference(noise).evidence) < 4.6


def test_errors_that_last_for_a_block_count_little_although_neighbours_resemble_each_other_little():
    """A constant of each block with a variance of a third of white noise: neighbours have a correlation of 0.25."""
    fit = Model.of(pendulum(), recorded(pendulum(), 2000, 0.0)).fit
    rng, errors = np.random.default_rng(0), []
    for windows in fit.blocks.windows:
        lasting = rng.standard_normal((len(fit.blocks), 1, 2))[windows.block]
        errors.append(np.sqrt(3.0) * rng.standard_normal((len(windows.rows), len(windows.horizons), 2)) + lasting)
    number = fit.blocks.steps / fit.blocks.windows[0].steps
    assert fit.effective_counts(errors)[0] == pytest.approx(4.0 / (3.0 + number), rel=0.5)
    assert fit.likeness_of_neighbours(errors) == pytest.approx(0.25, abs=0.1)
