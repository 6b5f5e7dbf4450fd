"""What the learner sees: real data and environments show it in the same way."""

from pathlib import Path

import hydra
import pytest
import torch
from environments import as_observed, make_reality, measure_observation_norm
from tensordict import TensorDict

CONFIG = Path(__file__).parents[2] / "recipes" / "config"


@pytest.fixture
def cfg():
    with hydra.initialize_config_dir(str(CONFIG), version_base=None):
        return hydra.compose("h2o_plus", ["env.make.max_episode_steps=7", "frames=3"])


def rollout(env):
    """Twenty transitions of the same torques, over three episodes that start alike."""
    env.set_seed(0)
    torch.manual_seed(0)
    data = env.rollout(20, break_when_any_done=False)
    keys = ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done"))
    return TensorDict({key: data[key] for key in keys}, data.batch_size)


def test_real_data_are_stacked_as_the_environment_stacks(cfg):
    raw = rollout(make_reality(cfg, raw=True))
    assert raw["observation"].shape == (20, 4)
    measure_observation_norm(cfg, raw)
    seen = rollout(make_reality(cfg))
    assert seen["observation"].shape == (20, 12)
    torch.testing.assert_close(seen["action"], raw["action"])
    shown = as_observed(cfg, raw)
    for key in ("observation", ("next", "observation")):
        torch.testing.assert_close(shown[key], seen[key], atol=1e-5, rtol=1e-4)
    assert not torch.equal(shown["observation"][1, :4], shown["observation"][1, 8:])
    assert torch.equal(shown["observation"][7, :4], shown["observation"][7, 8:])  # an episode's first, repeated
    assert raw["observation"].shape == (20, 4)


def test_without_stacking_the_latest_observation_is_shown(cfg):
    cfg.frames = 1
    raw = rollout(make_reality(cfg, raw=True))
    measure_observation_norm(cfg, raw)
    torch.testing.assert_close(
        as_observed(cfg, raw)["observation"], rollout(make_reality(cfg))["observation"], atol=1e-5, rtol=1e-4
    )
