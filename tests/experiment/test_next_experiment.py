"""An experiment tells apart what a log leaves open, within its limits, and says how likely it does."""

import json

import numpy as np
import pandas as pd
import pytest
import torch

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import ActionGain, BodyMass, Gravity, JointDamping, ObservationBias
from torchrl_h2o.experiment import next_experiment
from torchrl_h2o.experiment.design import Setting, best_commands
from torchrl_h2o.experiment.excitation import candidate
from torchrl_h2o.experiment.expected import as_ted, narrowed, told_apart
from torchrl_h2o.experiment.limits import Envelope, Limits
from torchrl_h2o.experiment.separation import Explained, Motion, Yardstick, nats_apart, predicted
from torchrl_h2o.residuals import Report
from torchrl_h2o.residuals.ground import Ground
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect, OtherExplanation
from torchrl_h2o.residuals.search import known_set

SIMULATION = double_pendulum()
RIGHT = (BodyMass(1.3, "lower"), JointDamping(0.01))
WRONG = (ActionGain(0.8), JointDamping(0.01))  # a lighter link moves further, and so it does under more torque
SAME = (ActionGain(1.0 / 1.3), JointDamping(0.01 / 1.3), BodyMass(1.0 / 1.3, "upper"))  # RIGHT, all divided by 1.3


@pytest.fixture(scope="module")
def measured():
    return recorded(SIMULATION.with_effects(*RIGHT), 800, 0.01)


@pytest.fixture(scope="module")
def log(measured):
    readings = np.concatenate([measured.observation, measured.following[-1:]])
    like = {"observation": torch.zeros(1, dtype=torch.float64)}
    return as_ted(readings, measured.action, like)


def setting_of(measured, *sets, within=1.0):
    catalogue = SIMULATION.catalogue()
    known = [known_set(catalogue, effects) for effects in sets]
    ground = Ground.of(SIMULATION, measured, known[0].effects)
    explanations = [Explained.of(ground, ground.found(one.entries, one.effects)) for one in known]
    limits = Limits.around(SIMULATION, np.zeros(4), measured.action, Envelope(within=within, speed=8.0))
    noise = 0.01 * measured.observation.std(0)
    return Setting(explanations, Yardstick.of(ground), limits, np.zeros(4), np.zeros(2), 200, 3.0, noise)


@pytest.fixture(scope="module")
def rivals(measured):
    return setting_of(measured, RIGHT, WRONG)


def drawn(setting, seed=0, family="multisine"):
    rng = np.random.default_rng(seed)
    return setting.largest(candidate(family, setting.seconds, 2, setting.band, rng))


def test_the_largest_commands_keep_the_limits_under_all_explanations_and_guards(measured, rivals):
    knots = candidate("steps", rivals.seconds, 2, 3.0, np.random.default_rng(0))
    kept = rivals.largest(knots)
    for index in range(2):
        assert rivals.limits.kept(rivals.motion(index, kept).states[None]).all()
    light = SIMULATION.with_effects(BodyMass(0.3))
    guarded = Setting(**(vars(rivals) | {"guards": (light,)})).largest(knots)
    assert np.abs(guarded).max() < np.abs(kept).max()
    assert setting_of(measured, RIGHT, within=1e-4).largest(knots) is None


def test_an_explanation_is_not_told_from_itself_and_a_rival_less_when_its_values_may_move(rivals):
    right, wrong = rivals.explanations
    motion = rivals.motion(0, drawn(rivals))
    seen = predicted(right.simulation, motion, rivals.yard)
    fixed = Explained(wrong.base, wrong.found, (), np.zeros((0, 0)))
    assert nats_apart(motion, right, seen, rivals.yard) == pytest.approx(0.0, abs=1e-9)
    assert 0.0 < nats_apart(motion, wrong, seen, rivals.yard) < nats_apart(motion, fixed, seen, rivals.yard)


def test_a_sensor_s_zero_is_seen_by_gravity_alone(measured):
    """A bias of the shoulder turns gravity; one of the upper joint about the vertical axis changes nothing."""
    setting = setting_of(measured, RIGHT)
    motion = setting.motion(0, drawn(setting))
    right = setting.explanations[0].simulation
    seen, weightless = predicted(right, motion, setting.yard), SIMULATION.with_effects(*RIGHT, Gravity(1e-9))
    biased = right.with_effects(ObservationBias(0.05, (0,)))
    assert np.abs(predicted(biased, motion, setting.yard) - seen).max() > 1.0
    floating = Motion.of(weightless, setting.rest, motion.actions)
    alike = predicted(weightless, floating, setting.yard)
    turned = weightless.with_effects(ObservationBias(0.05, (0,)))
    assert predicted(turned, floating, setting.yard) == pytest.approx(alike, abs=1e-3)


def test_no_motion_tells_apart_what_multiplies_all_masses_and_forces(measured):
    setting = setting_of(measured, RIGHT, SAME)
    apart = setting.nats(drawn(setting))
    assert max(apart.values()) < 0.1
    assert min(setting_of(measured, RIGHT, WRONG).nats(drawn(setting)).values()) > 1.0


def test_a_search_finds_commands_that_separate_more_than_random_ones(rivals):
    random = [rivals.value(drawn(rivals, seed)) for seed in range(6)]
    best = rivals.value(best_commands(rivals, np.random.default_rng(1), budget=6.0))
    assert best > max(random)


def test_commands_for_one_explanation_narrow_its_intervals(measured):
    alone = setting_of(measured, RIGHT)
    knots = drawn(alone)
    assert alone.value(knots) > 0.0
    assert all(0.0 < one.share < 1.0 for one in narrowed(alone, knots))
    assert all(
        more.share < one.share for one, more in zip(narrowed(alone, 0.3 * knots), narrowed(alone, knots), strict=True)
    )


def test_the_probability_is_that_of_the_search_on_both_logs(measured, log):
    setting = setting_of(measured, RIGHT, WRONG, SAME)
    apart = told_apart(setting, log, drawn(setting), np.random.default_rng(0))
    assert apart.diagonal().tolist() == [1.0] * 3
    assert apart[0, 1] > 0.9
    assert apart[0, 2] < 0.2  # no log tells it; it is only more surprising


@pytest.fixture(scope="module")
def report():
    found = tuple(FoundEffect(effect, declared=True, ci95={}, error_after=0.1) for effect in RIGHT)
    return Report(
        simulator="double pendulum",
        data=DataSummary("log.csv", 800, 200),
        found=found,
        others=(OtherExplanation(WRONG, 0.1),),
    )


def test_an_experiment_is_written_for_people_scripts_and_the_machine(report, log, tmp_path):
    experiment = next_experiment(
        SIMULATION, log, report, Envelope(seconds=2.0, within=1.0, speed=8.0), minutes=0.05, progress=False
    )
    experiment.save(tmp_path)
    commands = pd.read_csv(tmp_path / "commands.csv")
    assert list(commands)[1:] == list(SIMULATION.actuators)
    assert commands["time (s)"].iloc[-1] == pytest.approx(2.0 - SIMULATION.control_step)
    assert commands.iloc[[0, -1], 1:].to_numpy() == pytest.approx(np.zeros((2, 2)), abs=1e-6)
    told = json.loads((tmp_path / "experiment.json").read_text())
    assert told["told_apart"][0][1] == pytest.approx(experiment.told_apart[0, 1], abs=1e-3)
    assert [len(one) for one in told["explanations"]] == [2, 2]
    page = (tmp_path / "experiment.html").read_text()
    assert "mass of bodies lower" in page
    assert page.count("<svg") == 4
    assert "all actuators × 0.8" in experiment.words()


def test_a_report_without_effects_is_refused(log):
    with pytest.raises(ValueError, match="found no effects"):
        next_experiment(SIMULATION, log, Report(simulator="x", data=DataSummary("log.csv", 800, 200)), progress=False)
