"""Observations for the learner: real data and environments are transformed in the same way."""

from functools import partial

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from tests.composed import composed
from torchrl_h2o.data import episodes
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.training.environments import (
    as_observed,
    make_reality,
    measure_observation_norm,
    preprocessing_of,
    task_of,
)
from torchrl_h2o.training.preprocessing import Preprocessing
from torchrl_h2o.training.returns import SEED, evaluate


@pytest.fixture
def cfg():
    return composed("h2o_plus", "env.make.max_episode_steps=7", "frames=3")


def rollout(env):
    """Twenty transitions under fixed random torques, over three episodes with fixed initial states."""
    env.set_seed(0)
    torch.manual_seed(0)
    data = env.rollout(20, break_when_any_done=False)
    keys = ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done"))
    return TensorDict({key: data[key] for key in keys}, data.batch_size)


def test_real_data_are_stacked_as_the_environment_stacks(cfg):
    raw = rollout(task_of(cfg).make_reality())
    assert raw["observation"].shape == (20, 4)
    measure_observation_norm(cfg, raw)
    seen = rollout(make_reality(cfg))
    assert seen["observation"].shape == (20, 12)
    torch.testing.assert_close(seen["action"], raw["action"])
    shown = as_observed(cfg, raw)
    for key in ("observation", ("next", "observation")):
        torch.testing.assert_close(shown[key], seen[key], atol=1e-5, rtol=1e-4)
    assert not torch.equal(shown["observation"][1, :4], shown["observation"][1, 8:])
    # at the start of an episode the first observation is repeated
    assert torch.equal(shown["observation"][7, :4], shown["observation"][7, 8:])
    assert raw["observation"].shape == (20, 4)


def test_without_stacking_the_latest_observation_is_shown(cfg):
    cfg.frames = 1
    raw = rollout(task_of(cfg).make_reality())
    measure_observation_norm(cfg, raw)
    torch.testing.assert_close(
        as_observed(cfg, raw)["observation"], rollout(make_reality(cfg))["observation"], atol=1e-5, rtol=1e-4
    )


def observed(*columns):
    observation = torch.stack([torch.as_tensor(column, dtype=torch.float32).expand(1000) for column in columns], -1)
    return TensorDict(observation=observation, next=TensorDict(observation=observation, reward=torch.zeros(1000, 1)))


def test_entries_that_vary_have_unit_variance_whatever_their_unit():
    noise = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    real = observed(noise, 5.0 + 1e-3 * noise, 1e-9 * noise)
    shown = Preprocessing.fit(real, normalise=True).apply(real.auto_batch_size_(1))["observation"]
    torch.testing.assert_close(shown.std(0), torch.ones(3), atol=1e-2, rtol=0.0)


@pytest.mark.parametrize("value", [0.0, 0.1, -9.81, 1e4, 1e-9])
def test_an_entry_that_is_constant_in_the_data_keeps_its_unit(value):
    rounded = torch.tensor(value).repeat(1000)
    rounded[::2] = torch.nextafter(rounded[0], torch.tensor(torch.inf))
    real = observed(value, rounded)
    norm = Preprocessing.fit(real.auto_batch_size_(1), normalise=True).norm
    assert norm["scale"] == [1.0, 1.0]
    assert norm["loc"] == pytest.approx([value, value], rel=1e-5, abs=1e-30)


def test_a_normalisation_that_is_stored_is_used_as_it_is():
    stored = {"loc": [0.5], "scale": [1e-6]}  # of a constant entry, as earlier versions wrote it
    assert Preprocessing.fit(observed(0.5).auto_batch_size_(1), normalise=True, norm=stored).norm == stored


@pytest.fixture
def actor(cfg):
    cfg.env.make.max_episode_steps = 500
    env = make_reality(cfg)
    torch.manual_seed(0)
    return make_actor(env.observation_spec["observation"].shape[-1], env.action_spec_unbatched, [8])


def test_a_world_is_evaluated_as_one_env_is(cfg, actor):
    OmegaConf.update(cfg, "env.make.reset_noise", 0.0, force_add=True)
    alone, batched = evaluate(make_reality(cfg), actor, episodes=1), evaluate(make_reality(cfg, 1), actor, episodes=1)
    assert batched.lengths == alone.lengths
    assert alone.lengths[0] < 500  # the robot fell
    assert batched.returns == pytest.approx(alone.returns, rel=1e-4)


def test_worlds_at_once_have_episodes_of_their_own_that_count_to_their_ends(cfg, actor):
    worlds = make_reality(cfg, 3)
    at_once = evaluate(worlds, actor, episodes=3)
    assert len(set(at_once.lengths)) == 3
    first = evaluate(make_reality(cfg, 1), actor, episodes=1)
    assert (at_once.lengths[0], at_once.returns[0]) == (first.lengths[0], pytest.approx(first.mean, rel=1e-4))
    assert evaluate(worlds, actor, episodes=4).returns[:3] == at_once.returns
    assert evaluate(worlds, actor, episodes=2).returns == at_once.returns[:2]


@pytest.mark.parametrize("past", [0, 2])
@pytest.mark.parametrize("worlds", [None, 3])
def test_an_evaluation_measures_observations_in_physical_units(cfg, worlds, past):
    cfg.action_history = past
    cfg.env.make.max_episode_steps = 60
    cfg.observation_norm = {"loc": [1.0, 2.0, 3.0, 4.0], "scale": [0.1, 10.0, 0.5, 2.0]}

    push = TensorDictModule(lambda seen: torch.full((*seen.shape[:-1], 1), 2.0), ["observation"], ["action"])
    measured = evaluate(make_reality(cfg, worlds), push, 3, physical=partial(preprocessing_of(cfg).physical, size=4))
    raw = task_of(cfg).make_reality(worlds)
    torch.manual_seed(SEED)
    raw.set_seed(SEED)
    steps = raw.rollout(3 * 60, push, break_when_any_done=False)
    # an evaluation of one env resets again after each episode, so it skips every other one of the rollout
    alone = list(episodes(steps))[:5:2] if worlds is None else [next(iter(episodes(stream))) for stream in steps]
    assert [len(episode) for episode in alone] == measured.lengths
    assert min(measured.lengths) < 60  # the robot fell
    for i, episode in enumerate(alone):
        seen = episode["next", "observation"].double()
        torch.testing.assert_close(measured.mean_observation[i], seen.mean(0), atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(measured.max_observation[i], seen.abs().amax(0), atol=1e-5, rtol=1e-4)
    told = measured.observed(["theta", "theta_dot", "x", "v"])["v"]
    assert told["mean"] == pytest.approx(float(measured.mean_observation[:, 3].mean()))
    assert told["max_abs"] == pytest.approx(float(measured.max_observation[:, 3].max()))


def test_an_evaluation_leaves_the_state_of_torch_s_cpu_generator(cfg, actor):
    cfg.env.make.max_episode_steps = 7
    before = torch.get_rng_state()
    evaluate(make_reality(cfg), actor, episodes=1)
    assert torch.equal(torch.get_rng_state(), before)


def test_an_evaluation_that_measures_nothing_has_no_statistics(cfg, actor):
    cfg.env.make.max_episode_steps = 7
    assert evaluate(make_reality(cfg), actor, episodes=1).observed(["theta"]) == {}
