"""The option ``warm_start``: the policy begins at the behaviour in the real data, and is held while critics learn."""

from copy import deepcopy

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.small_runs import assert_resumed_equals_whole
from torchrl_h2o.training import loop, warm_start
from torchrl_h2o.training.config_file import save_config
from torchrl_h2o.training.environments import as_observed, make_reality, make_replay
from torchrl_h2o.training.learner import Learner
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.populations.job import run_population
from torchrl_h2o.training.populations.loop import members_of
from torchrl_h2o.training.trained_policy import load_policy
from torchrl_h2o.training.warm_start import prepare_warm_start

LONGER = "env.recording.num_transitions=2000"
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in sorted(METHODS) if name != "sac"]


@pytest.fixture
def clones(monkeypatch):
    """The parameters of each policy right after it was cloned."""
    found, clone = [], warm_start.clone_behaviour

    def cloning(actor, *args):
        clone(actor, *args)
        found.append(deepcopy(list(actor.parameters())))

    monkeypatch.setattr(warm_start, "clone_behaviour", cloning)
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


def test_commands_at_and_beyond_the_limits_of_the_motor_do_not_outweigh_the_others(compose):
    cfg, real = compose("warm_start=true", "num_cells=[32,32]", LONGER, config="train")
    spec = make_reality(cfg).action_spec_unbatched
    real["action"] *= spec.space.high / real["action"].abs().quantile(0.85)  # 15 % beyond the limits
    actor = METHODS["sac"].make_learner(cfg, 4, spec, make_replay(cfg, real)).actor
    real["action"] = real["action"].clamp(spec.space.low, spec.space.high)
    assert unlike(actor, cfg, real) < 0.75


def test_a_training_begins_at_the_policy_of_an_earlier_run_with_its_normalisation(compose, tmp_path, clones):
    earlier, real = compose("warm_start=true", "updates=20", "method=sac", config="train")
    policy, _ = train(METHODS["sac"], earlier, real, tmp_path)
    save_config(earlier, tmp_path)
    clones.clear()
    cfg, real = compose(f"warm_start={tmp_path}", config="train")
    cfg.observation_norm = None
    prepare_warm_start(cfg)
    assert cfg.observation_norm == earlier.observation_norm
    for name in ("sac", "td3_bc"):
        begun = (
            METHODS[name].make_learner(cfg, 4, make_reality(cfg).action_spec_unbatched, make_replay(cfg, real)).actor
        )
        assert are_equal(begun.parameters(), policy.parameters())
    assert not clones
    cfg.num_cells = [9]
    with pytest.raises(ValueError, match="its policy has other inputs or layers"):
        METHODS["sac"].make_learner(cfg, 4, make_reality(cfg).action_spec_unbatched, make_replay(cfg, real))


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
