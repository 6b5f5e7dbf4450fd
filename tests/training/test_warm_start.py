"""The option ``warm_start``: the policy begins at the behaviour in the real data, and is held while critics learn."""

from copy import deepcopy

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.small_runs import ROBOT, SMALL, assert_resumed_equals_whole, run, trained
from torchrl_h2o.training import loop, warm_start
from torchrl_h2o.training.environments import as_observed, make_reality
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.populations.job import run_population
from torchrl_h2o.training.populations.loop import members_of
from torchrl_h2o.training.trained_policy import load_policy

LONGER = "env.recording.num_transitions=2000"
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in sorted(METHODS) if name != "sac"]


@pytest.fixture
def clones(monkeypatch):
    """The parameters of each policy right after it was cloned."""
    found, clone = [], warm_start.clone_behaviour

    def cloning(actor, *args):
        clone(actor, *args)
        found.append(deepcopy(list(actor.parameters())))

    monkeypatch.setattr(loop, "clone_behaviour", cloning)
    return found


def are_equal(parameters, others):
    return all(torch.equal(p, q) for p, q in zip(parameters, others, strict=True))


def unlike(policy, cfg, real):
    """Share of the actions' variance that a policy does not repeat."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = policy(as_observed(cfg, real).select("observation"))["action"]
    return float((action - real["action"]).square().mean() / real["action"].var())


@pytest.mark.parametrize("name", ["sac", *OTHERS])
def test_a_policy_is_held_while_the_critics_learn_and_moves_afterwards(compose, tmp_path, name, clones, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=40", "updates_per_epoch=20", config="train")
    learners, update = [], Learner.update

    def updating(self, is_held=False):
        before = deepcopy(list(self.parameters))
        terms = update(self, is_held)
        learners.append((is_held, are_equal(self.actor.parameters(), clones[0]), are_equal(self.parameters, before)))
        return terms

    monkeypatch.setattr(Learner, "update", updating)
    train(METHODS[name], cfg, real, tmp_path)
    assert [is_held for is_held, *_ in learners] == [True] * 20 + [False] * 20
    assert [at_clone for _, at_clone, _ in learners] == [True] * 20 + [False] * 20
    assert not any(nothing_moved for *_, nothing_moved in learners)


def test_a_policy_begins_at_the_behaviour(compose, tmp_path, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=20", "num_cells=[32,32]", LONGER, config="train")
    monkeypatch.setattr(loop, "held_updates", lambda cfg: 20)
    policy, _ = train(METHODS["sac"], cfg, real, tmp_path)
    assert unlike(policy, cfg, real) < 0.7  # the rest is the noise of the behaviour


def test_the_first_step_of_a_policy_is_no_larger_than_without_holding_it():
    moved = []
    for held in (0, 50):
        parameter = torch.nn.Parameter(torch.zeros(1))
        optimiser = torch.optim.Adam([parameter], lr=1.0)
        for number in range(held + 1):
            optimiser.zero_grad()
            parameter.sum().backward()
            if number < held:
                warm_start.hold([parameter], optimiser)
            optimiser.step()
        moved.append(float(parameter.detach()))
    assert moved[0] == pytest.approx(-1.0)
    assert -1.0 <= moved[1] < -0.5


def test_the_target_of_a_policy_is_cloned_with_it(compose, tmp_path, clones, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=20", config="train")
    targets, update = [], Learner.update

    def updating(self, is_held=False):
        params = self.losses["loss"].target_actor_network_params
        targets.append(deepcopy(list(params.flatten_keys(".").values(True, True))))
        return update(self, is_held)

    monkeypatch.setattr(Learner, "update", updating)
    train(METHODS["td3_bc"], cfg, real, tmp_path)
    assert {float(p.sum()) for p in targets[0]} == {float(p.sum()) for p in clones[0]}


def test_actions_at_the_limits_of_the_motor_can_be_cloned(compose):
    cfg, real = compose(config="train")
    env = make_reality(cfg)
    space = env.action_spec_unbatched.space
    real["action"] = torch.where(real["action"] > 0.0, space.high, space.low)
    learner = METHODS["sac"].make_learner(cfg, 4, env.action_spec_unbatched, loop.make_replay(cfg, real))
    warm_start.clone_behaviour(learner.actor, env.action_spec_unbatched, as_observed(cfg, real), 0)
    assert all(parameter.isfinite().all() for parameter in learner.actor.parameters())
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        far = learner.actor(as_observed(cfg, real).select("observation"))["action"].abs().max()
    assert far < space.high  # at the limit itself, a tanh has no gradient


@pytest.mark.slow
def test_training_on_is_training_in_one_go(compose, tmp_path, monkeypatch):
    cfg, real = compose("warm_start=true", "updates=60", config="train")
    assert_resumed_equals_whole(METHODS["h2o_plus"], cfg, real, tmp_path, monkeypatch)


@pytest.mark.slow
def test_a_population_holds_its_policies(compose, tmp_path, clones, monkeypatch):
    cfg, _ = compose("warm_start=true", "updates=20", "seeds=[0,1]", config="train")
    for held, is_held in ((20, True), (19, False)):
        monkeypatch.setattr("torchrl_h2o.training.populations.loop.held_updates", lambda cfg, held=held: held)
        clones.clear()
        run_population(cfg, members_of(cfg), tmp_path / str(held))
        for clone, (name, own) in zip(clones, members_of(cfg).items(), strict=True):
            own.observation_norm = cfg.observation_norm
            assert are_equal(load_policy(own, tmp_path / str(held) / name).parameters(), clone) is is_held


@pytest.mark.slow
def test_the_loop_of_the_recipe_reaches_the_numbers_of_the_loop_of_train(command, tmp_path):
    small = [*SMALL, *ROBOT, "warm_start=true"]
    run(command(*small, "hydra.run.dir=recipe"))
    run(command(*small, "hydra.run.dir=package", script="train.py"))
    assert trained(tmp_path / "recipe") == trained(tmp_path / "package")
