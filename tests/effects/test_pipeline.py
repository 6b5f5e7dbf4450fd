"""The pipeline: effects applied step by step and to whole runs, in order, with negative noise and ``random``."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
import pytest

from tests.effects.models import CART, spec
from torchrl_h2o.effects import (
    ActionBias,
    ActionDelay,
    ActionEffect,
    ActionGain,
    ActionLag,
    ActionNoise,
    Gravity,
    JointForce,
    LinearDrag,
    ObservationBias,
    ObservationDelay,
    ObservationGain,
    ObservationNoise,
    Pipeline,
    parameter,
)
from torchrl_h2o.effects.states import States

DT = 0.02


@dataclass(frozen=True)
class UnmarkedNoise(ActionEffect):
    """Noise whose class is not marked random."""

    wording: ClassVar[str] = "unmarked noise of {std}"
    std: float = parameter(unit="1", bounds=(0.0, 1.0), neutral=0.0)

    def process(self, dt, rng):
        return lambda action: action + self.std * rng.standard_normal(action.shape)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_actions_and_observations_pass_through_their_effects_in_order():
    pipeline = Pipeline([ActionBias(1.0), ObservationGain(3.0), ActionGain(2.0), ObservationBias(1.0), Gravity(2.0)])
    episode = pipeline.begin(DT)
    np.testing.assert_array_equal(episode.executed(np.ones(2)), [4.0, 4.0])
    np.testing.assert_array_equal(episode.observed(np.ones(2)), [4.0, 4.0])


@pytest.mark.parametrize("noise", [(), (ActionNoise(1.0), ActionNoise(-0.6))])
def test_a_whole_run_equals_its_steps(noise):
    pipeline = Pipeline([ActionGain(0.7), ActionDelay(0.03), ActionLag(0.05), *noise])
    actions = rng().uniform(-1, 1, (30, 2))
    episode = pipeline.begin(DT, rng())
    stepwise = [episode.executed(action) for action in actions]
    np.testing.assert_allclose(pipeline.executed_run(actions, DT, rng()), stepwise, atol=1e-12)


def test_an_episode_keeps_no_state_of_another():
    pipeline = Pipeline([ActionDelay(DT)])
    first, second = pipeline.begin(DT), pipeline.begin(DT)
    first.executed(np.ones(1))
    np.testing.assert_array_equal(second.executed(np.ones(1)), [0.0])


def test_a_step_leaves_the_given_array_alone():
    action = np.ones(1, dtype=np.float32)
    executed = Pipeline([ActionDelay(DT)]).begin(DT).executed(action)
    assert executed.dtype == np.float64
    np.testing.assert_array_equal(action, 1.0)


def test_a_run_without_a_generator_skips_random_effects():
    actions = np.ones((5, 1))
    pipeline = Pipeline([ActionNoise(1.0), ActionGain(2.0)])
    np.testing.assert_array_equal(pipeline.executed_run(actions, DT), 2.0 * actions)
    assert not np.allclose(pipeline.executed_run(actions, DT, rng()), 2.0 * actions)


def test_only_effects_that_are_random_and_not_neutral_make_a_pipeline_random():
    assert Pipeline([ObservationNoise(0.1)]).is_random
    assert not Pipeline([ObservationNoise(0.0), ActionGain(2.0)]).is_random
    assert not Pipeline([ActionNoise(1.0), ActionNoise(-1.0)]).is_random


@pytest.mark.parametrize("others", [[], [ActionNoise(0.5)]])
def test_an_effect_that_draws_without_being_marked_random_raises(others):
    pipeline = Pipeline([*others, UnmarkedNoise(0.5)])
    complaint = r"UnmarkedNoise\(std=0.5\) draws random numbers, but.*random: ClassVar\[bool\] = True"
    with pytest.raises(ValueError, match=complaint):
        pipeline.begin(DT, rng()).executed(np.ones(1))
    with pytest.raises(ValueError, match=complaint):
        pipeline.executed_run(np.ones((2, 1)), DT, rng())


def test_noise_is_settled_across_groups():
    settled = Pipeline.balanced_together({"inner": [ActionNoise(1.0), Gravity(2.0)], "outer": [ActionNoise(-0.6)]})
    assert settled["inner"] == Pipeline([ActionNoise(0.8), Gravity(2.0)])
    assert settled["outer"] == Pipeline([ActionNoise(0.0)])
    with pytest.raises(ValueError, match="put it behind an ActionNoise"):
        Pipeline.balanced_together({"inner": [ActionNoise(-0.6)], "outer": [ActionNoise(1.0)]})


def test_excess_negative_noise_raises_where_actions_are_altered_and_only_there():
    pipeline = Pipeline([ActionNoise(-1.0), ObservationBias(0.5), JointForce(1.0, "hinge")])
    model = pipeline.compile(spec(CART))
    assert len(pipeline.batched_forces(model)) == 1
    np.testing.assert_array_equal(pipeline.observe_memoryless(np.zeros((2, 1)), DT), 0.5)
    for alter in (lambda: pipeline.begin(DT, rng()), lambda: pipeline.executed_run(np.zeros((2, 1)), DT)):
        with pytest.raises(ValueError, match="put it behind an ActionNoise"):
            alter()


def test_a_delay_of_the_whole_observation_delays_the_actions_of_a_run_instead():
    actions, observations = rng().standard_normal((20, 1)), rng().standard_normal((20, 2))
    sensors, actuators = Pipeline([ObservationDelay(0.03)]), Pipeline([ActionDelay(0.03)])
    np.testing.assert_array_equal(sensors.executed_run(actions, DT), actuators.executed_run(actions, DT))
    np.testing.assert_array_equal(sensors.restore_run(observations, DT), observations)
    np.testing.assert_array_equal(sensors.undelay_run(observations, DT), observations)


def test_a_run_is_restored_from_the_last_sensor_to_the_first():
    true = rng().standard_normal((20, 2))
    pipeline = Pipeline([ObservationGain(0.5, (1,)), ObservationBias(0.1, (1,)), ObservationDelay(DT, (0,))])
    episode = pipeline.begin(DT)
    reported = np.array([episode.observed(observation) for observation in true])
    restored = pipeline.restore_run(reported, DT)
    np.testing.assert_allclose(restored[:-1], true[:-1], atol=1e-12)
    assert np.isnan(restored[-1, 0])
    undelayed = pipeline.undelay_run(reported, DT)
    np.testing.assert_allclose(undelayed[:-1, 0], true[:-1, 0], atol=1e-12)
    np.testing.assert_array_equal(undelayed[:, 1], reported[:, 1])


def test_memoryless_sensors_are_those_without_noise_and_delay():
    pipeline = Pipeline([ObservationNoise(1.0), ObservationGain(2.0), ObservationDelay(DT), ObservationBias(1.0)])
    np.testing.assert_array_equal(pipeline.observe_memoryless(np.ones((3, 4, 2)), DT), 3.0)


def test_forces_of_an_episode_are_those_of_many_states():
    pipeline = Pipeline([JointForce(3.0, "hinge"), LinearDrag(0.7), JointForce(0.0), ActionGain(2.0)])
    model = pipeline.compile(spec(CART))
    data = mujoco.MjData(model)
    data.qvel[:] = rng().standard_normal(model.nv)
    mujoco.mj_forward(model, data)
    together = sum(force(States.of(data)) for force in pipeline.batched_forces(model))[0]
    episode = pipeline.begin(DT, model=model)
    assert len(episode.forces) == 2
    np.testing.assert_allclose(sum(force(data) for force in episode.forces), together, atol=1e-12)
    assert not pipeline.begin(DT).forces


def test_pipelines_of_equal_effects_are_equal():
    assert len({Pipeline([Gravity(2.0)]), Pipeline((Gravity(2.0),)), Pipeline([Gravity(1.0)])}) == 2
