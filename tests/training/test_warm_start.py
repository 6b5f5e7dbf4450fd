"""The option ``warm_start``: the policy begins at the behaviour in the real data, and is held while critics learn."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.small_runs import ROBOT, SMALL, assert_resumed_equals_whole, rows, run, trained
from torchrl_h2o.training.environments import as_observed, make_reality
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.populations.job import run_population
from torchrl_h2o.training.populations.loop import members_of
from torchrl_h2o.training.trained_policy import load_policy

LONGER = "env.recording.num_transitions=2000"


def actions(policy, cfg, real):
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(as_observed(cfg, real).select("observation"))["action"]


@pytest.mark.parametrize(
    "name", ["sac", *(pytest.param(n, marks=pytest.mark.slow) for n in sorted(METHODS) if n != "sac")]
)
def test_a_policy_begins_at_the_behaviour_and_is_held(compose, tmp_path, name, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=20", "num_cells=[32,32]", LONGER, config="train")
    monkeypatch.setattr("torchrl_h2o.training.loop.HELD", 20)
    cloned, _ = train(METHODS[name], cfg, real, tmp_path / "held")
    unlike = (actions(cloned, cfg, real) - real["action"]).square().mean() / real["action"].var()
    assert unlike < 0.7  # the rest is the noise of the behaviour
    monkeypatch.setattr("torchrl_h2o.training.loop.HELD", 10)
    moved, _ = train(METHODS[name], cfg, real, tmp_path / "moved")
    assert any((p != q).any() for p, q in zip(moved.parameters(), cloned.parameters(), strict=True))


def test_the_critics_learn_while_the_policy_is_held(compose, tmp_path, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=40", config="train")
    monkeypatch.setattr("torchrl_h2o.training.loop.HELD", 40)
    train(METHODS["sac"], cfg, real, tmp_path)
    before, after = (float(row["loss_qvalue"]) for row in rows(tmp_path))
    assert before != after


def test_actions_at_the_limits_of_the_motor_can_be_cloned(compose, tmp_path):
    cfg, real = compose("warm_start=true", "updates=20", config="train")
    space = make_reality(cfg).action_spec_unbatched.space
    real["action"] = torch.where(real["action"] > 0.0, space.high, space.low)
    policy, _ = train(METHODS["sac"], cfg, real, tmp_path)
    assert all(parameter.isfinite().all() for parameter in policy.parameters())


@pytest.mark.slow
def test_training_on_is_training_in_one_go(compose, tmp_path, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=60", config="train")
    with pytest.MonkeyPatch.context() as held:  # lasts beyond the interruption, which ``monkeypatch`` undoes
        held.setattr("torchrl_h2o.training.loop.HELD", 30)
        assert_resumed_equals_whole(METHODS["h2o_plus"], cfg, real, tmp_path, monkeypatch)


@pytest.mark.slow
def test_a_population_holds_its_policies(compose, tmp_path, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=20", "num_cells=[32,32]", "seeds=[0,1]", LONGER, config="train")
    run_population(cfg, members_of(cfg), tmp_path)
    for name, own in members_of(cfg).items():
        own.observation_norm = cfg.observation_norm
        policy = load_policy(own, tmp_path / name)
        assert (actions(policy, own, real) - real["action"]).square().mean() < 0.7 * real["action"].var()


@pytest.mark.slow
def test_the_loop_of_the_recipe_reaches_the_numbers_of_the_loop_of_train(command, tmp_path):
    small = [*SMALL, *ROBOT, "warm_start=true"]
    run(command(*small, "hydra.run.dir=recipe"))
    run(command(*small, "hydra.run.dir=package", script="train.py"))
    assert trained(tmp_path / "recipe") == trained(tmp_path / "package")
