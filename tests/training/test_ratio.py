"""``ratio_estimator``: the estimator, its pairs, and runs that train with it."""

import pytest
import torch

from tests.small_runs import ROBOT, SMALL, assert_resumed_equals_whole, rows, run
from tests.training.fixed_numbers import FixedNumbers
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.environments import as_observed, preprocessing_of, task_of
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.populations.loop import members_of, train_population
from torchrl_h2o.training.ratio import make_pairs, make_ratio_loss


def pairs_of(cfg, real):
    replay = HybridReplayBuffer(as_observed(cfg, real), 100)
    return make_pairs(cfg, task_of(cfg), real, preprocessing_of(cfg), replay), replay


def test_paper_has_two_networks_and_no_pairs(compose):
    cfg, real = compose(config="train")
    pairs, replay = pairs_of(cfg, real)
    assert pairs is None
    assert make_ratio_loss(cfg, 4, 1, replay).estimator.sa_network is not None


def test_pairs_of_a_simulator_equal_to_reality_are_equal(compose):
    options = ("ratio_estimator=pairs", "env.simulator=${env.reality}", "frames=2")
    cfg, real = compose(*options, config="train")
    pairs, replay = pairs_of(cfg, real)
    assert 0 < len(pairs) < len(real)
    batch = pairs.sample((50, 50))
    assert batch["next", "observation"].shape == (100, replay.real[:]["observation"].shape[-1])
    gap, _ = pairs_of(compose("ratio_estimator=pairs", config="train")[0], real)
    assert mean_difference(pairs) < 0.1 * mean_difference(gap)


def mean_difference(pairs):
    torch.manual_seed(0)
    real, simulated = pairs.sample((500, 500))["next", "observation"].chunk(2)
    return (real - simulated).abs().mean()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["h2o_plus", "h2o", "darc", "dara", "td3"])
def test_methods_train_and_resume_with_pairs(compose, tmp_path, name, monkeypatch):
    cfg, real = compose("updates=60", "ratio_estimator=pairs", config="train")
    _, training = assert_resumed_equals_whole(METHODS[name], cfg, real, tmp_path, monkeypatch)
    assert all(torch.isfinite(torch.tensor(value)) for row in training.rows for value in list(row.values())[1:])


@pytest.mark.slow
def test_without_random_numbers_a_member_trained_on_pairs_learns_what_a_single_run_learns(compose, tmp_path):
    cfg, real = compose("ratio_estimator=pairs", "seeds=[0,1]", "gaps=[null,gravity]", config="train")
    members = members_of(cfg)
    name = "seed_1_gravity"
    with FixedNumbers():
        outcomes = train_population(METHODS["h2o_plus"].make_learner, cfg, members, real, tmp_path / "population")
        _, training = train(METHODS["h2o_plus"], members[name], real, tmp_path / name)
    for together, alone in zip(outcomes[name].rows, training.rows, strict=True):
        assert "loss_ratio_sa" not in alone
        assert "loss_ratio_sa" not in together
        for key in ("unclamped_ratio", "effective_sample_size", "loss_ratio_sas", "return_real"):
            assert together[key] == pytest.approx(alone[key], rel=1e-4)


@pytest.mark.slow
def test_the_recipe_trains_with_pairs(command, tmp_path):
    run(command(*SMALL, *ROBOT, "ratio_estimator=pairs", "hydra.run.dir=out"))
    last = rows(tmp_path / "out")[-1]
    assert 0.0 < float(last["effective_sample_size"]) <= 1.0
    assert "loss_ratio_sa" not in last
