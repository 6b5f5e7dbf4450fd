"""Every method of the comparison: it trains with the common loop, resumes where it stopped, and can be evaluated."""

import json
import math
import subprocess

import pytest
import torch

from tests.small_runs import ROBOT, SMALL, assert_resumed_equals_whole, rows, run
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.training.environments import as_observed, make_reality
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS
from torchrl_h2o.training.trained_policy import load_policy

methods = pytest.mark.parametrize("name", METHODS)
OFFLINE = ("cql", "iql", "td3_bc")


@pytest.mark.slow
def test_one_command_trains_a_method_and_another_replays_it(command, tmp_path):
    printed = run(command("method=darc", *SMALL, *ROBOT, "hydra.run.dir=out", script="train.py"))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["method"] == "DARC"
    assert "backbone" not in summary
    assert {row["method"] for row in rows(tmp_path / "out")} == {"DARC"}
    assert (tmp_path / "out" / "learning_curve.png").stat().st_size > 10_000
    assert "DARC" in printed
    replayed = run(command("checkpoint=out", "episodes=1", "film=null", script="evaluate.py"))
    assert "DARC in reality" in replayed


@pytest.mark.slow
def test_a_method_that_there_is_not_is_said(command):
    done = subprocess.run(**command("method=ppo", script="train.py"), text=True, check=False)
    assert done.returncode != 0
    assert "method=ppo: must be sac, cql, iql, td3_bc, darc" in done.stdout


@pytest.mark.slow
@methods
def test_each_method_moves_its_policy_and_training_on_is_training_in_one_go(compose, tmp_path, name, monkeypatch):
    cfg, real = compose("updates=60", "lr_end_factor=0.1", config="train")
    method = METHODS[name]
    policy, training = assert_resumed_equals_whole(method, cfg, real, tmp_path, monkeypatch)
    assert len(training.rows) == 3
    assert all(torch.isfinite(torch.tensor(value)) for row in training.rows for value in list(row.values())[1:])
    first = method_policy(method, cfg, real, tmp_path / "first")
    assert all((p != q).any() for p, q in zip(policy.parameters(), first.parameters(), strict=True))


FAST = {"h2o_plus", "sac"}
WITHOUT_CORRECTION = {
    "par": ["par.beta=0.0"],
    "dara": ["dara.eta=0.0"],
}  # it is counted for each step, see test_reward_correction.py


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in sorted(METHODS.keys() - {"darc"})],
)  # darc also counts its reward correction n times
def test_the_discount_of_each_method_is_that_of_the_steps_of_a_row(compose, name):
    def loss_qvalue(gamma, steps):
        chosen = WITHOUT_CORRECTION.get(name, [])
        cfg, real = compose(f"method={name}", f"gamma={gamma}", "n_steps=1", *chosen)
        real = as_observed(cfg, real)
        replay = HybridReplayBuffer(real, 100, (8, 8))
        replay.extend(real[:50])
        learner = METHODS[name].make_learner(cfg, 4, make_reality(cfg).action_spec_unbatched, replay)
        torch.manual_seed(1)
        batches = learner.sample()
        for batch in batches:
            batch["steps_to_next_obs"] = torch.full((len(batch), 1), steps)
        torch.manual_seed(2)
        return learner.terms_of(*batches)["loss_qvalue"].item()

    three_steps = loss_qvalue(0.8, steps=3)
    assert three_steps == pytest.approx(loss_qvalue(0.8**3, steps=1), rel=1e-5)
    assert three_steps != pytest.approx(loss_qvalue(0.8, steps=1), rel=1e-3)


def method_policy(method, cfg, real, directory):
    """The method's initial policy: training with a learning rate of zero."""
    still = cfg.copy()
    still.lr = 0.0
    return train(method, still, real, directory)[0]


@pytest.mark.slow
@methods
def test_each_method_sees_the_data_that_the_paper_gives_it(compose, tmp_path, name, monkeypatch):
    cfg, real = compose("updates=20", config="train")
    sizes = []
    monkeypatch.setattr("torchrl_h2o.training.learner.Learner.update", recorded(sizes))
    train(METHODS[name], cfg, real, tmp_path)
    policy_s, *discriminators = sizes[0]
    expected = {"sac": (0, 16), "darc": (0, 16), "cql": (16, 0), "iql": (16, 0), "td3_bc": (16, 0)}
    assert tuple(policy_s) == expected.get(name, (8, 8))
    assert [tuple(size) for size in discriminators] == (
        [(8, 8)] if name in ("darc", "dara", "h2o", "h2o_plus", "td3") else []
    )


def recorded(sizes):
    from torchrl_h2o.training.learner import Learner

    update = Learner.update

    def recording(self, is_held=False):
        sizes.append(list(self.batch_sizes))
        return update(self)

    return recording


@pytest.mark.slow
@pytest.mark.parametrize("name", OFFLINE)
def test_no_gap_touches_a_method_that_learns_from_real_data_alone(compose, tmp_path, name):
    returns = []
    for gap in ("gap=null", "gap=gravity"):
        cfg, real = compose("updates=20", gap, config="train")
        _, training = train(METHODS[name], cfg, real, tmp_path / gap)
        returns.append(training.rows[-1]["return_real"])
    assert returns[0] == returns[1]


def parts(name, compose, *overrides):
    """Returns a method's learner and its first batches; every call returns the same numbers."""
    cfg, real = compose(f"method={name}", *overrides, config="train")
    torch.manual_seed(0)
    spec = make_reality(cfg).action_spec_unbatched
    real = as_observed(cfg, real)
    replay = HybridReplayBuffer(real, sim_capacity=100)
    replay.extend(real[:50])
    learner = METHODS[name].make_learner(cfg, 4, spec, replay)
    return learner, [replay.sample(size) for size in learner.batch_sizes]


def test_darc_learns_from_corrected_rewards(compose):
    learner, (batch, pairs) = parts("darc", compose)
    task_s = batch["next", "reward"].clone()
    learner.terms_of(batch, pairs)
    log_ratio = learner.losses["ratio_loss"].estimator(batch.clone())["log_dynamics_ratio"]
    scale = compose("method=darc", config="train")[0].reward_scale
    assert scale != 1.0
    # Δr of DARC's Eq. (1): log p_reality − log p_simulator, in the scale of the task's own reward
    torch.testing.assert_close(batch["next", "reward"].squeeze(-1), task_s.squeeze(-1) + scale * log_ratio)


def test_dara_corrects_simulated_rewards_by_the_clipped_ratio_and_trains_on_both_streams(compose):
    learner, (batch, pairs) = parts("dara", compose, "dara.eta=2.0", "dara.clip=0.01")
    task_s = batch["next", "reward"].clone()
    terms = learner.terms_of(batch, pairs)
    log_ratio = learner.losses["ratio_loss"].estimator(batch.clone())["log_dynamics_ratio"].clamp(-0.01, 0.01)
    assert (log_ratio.abs() == 0.01).any()
    scale = 2.0 * compose("method=dara", config="train")[0].reward_scale
    expected = task_s.squeeze(-1) + scale * torch.where(batch["real"], 0.0, log_ratio)
    torch.testing.assert_close(batch["next", "reward"].squeeze(-1), expected)
    assert {"loss_actor", "loss_qvalue", "loss_value", "loss_ratio_sa"} <= set(terms)


def test_rebrac_s_penalty_reads_the_next_actions_of_the_data_and_without_it_td3_bc_is_torchrl_s(compose):
    found = []
    for penalty in (0.0, 2.0):
        learner, batches = parts("td3_bc", compose, f"td3_bc.critic_penalty={penalty}")
        assert (("next", "action") in learner.replay.keys) == (penalty > 0)
        if penalty:
            (batch,) = batches = learner.sample()
            assert batch["next", "action"].abs().max() <= 3.0
        found.append(learner.terms_of(*batches)["loss_qvalue"])
    assert found[0] != found[1]


@pytest.mark.slow
def test_rebrac_goes_on_where_it_stopped(compose, tmp_path, monkeypatch):
    cfg, real = compose("td3_bc.critic_penalty=1.0")
    assert_resumed_equals_whole(METHODS["td3_bc"], cfg, real, tmp_path, monkeypatch)


def test_par_lowers_simulated_rewards_by_the_deviation_alone(compose):
    learner, (batch,) = parts("par", compose, "par.beta=2.0")
    task_s = batch["next", "reward"].clone()
    learner.terms_of(batch)
    deviation = learner.losses["representation_loss"].representation(batch.clone())["representation_deviation"]
    scale = compose("method=par", config="train")[0].reward_scale
    expected = task_s.squeeze(-1) - 2.0 * scale * torch.where(batch["real"], 0.0, deviation)
    torch.testing.assert_close(batch["next", "reward"].squeeze(-1), expected)


def test_h2o_weighs_simulated_rows_alone_and_adds_its_term(compose):
    learner, (batch, pairs) = parts("h2o", compose)
    losses = learner.terms_of(batch, pairs)
    for key in ("dynamics_ratio", "dynamics_divergence"):
        assert (batch[key][batch["real"]] == 1.0).all()
    assert (batch["dynamics_divergence"][~batch["real"]] != 1.0).all()
    assert {"loss_conservative", "loss_qvalue", "loss_ratio_sa"} <= losses.keys()


def test_h2o_s_backup_holds_no_entropy_and_its_term_alpha_c(compose):
    found = []
    for alpha_c, alpha in ((0.01, 1.0), (0.02, 50.0)):
        learner, batches = parts("h2o", compose, f"h2o.alpha_c={alpha_c}")
        learner.losses["loss"].loss.log_alpha.data.fill_(math.log(alpha))
        torch.manual_seed(1)
        found.append(learner.terms_of(*batches))
    torch.testing.assert_close(found[1]["loss_conservative"], 2 * found[0]["loss_conservative"])
    torch.testing.assert_close(found[1]["loss_qvalue"], found[0]["loss_qvalue"])
    assert not torch.allclose(found[1]["loss_actor"], found[0]["loss_actor"])


def test_cql_s_policy_is_not_also_told_to_copy(compose):
    learner, batches = parts("cql", compose)
    assert {"loss_actor", "loss_qvalue", "loss_cql", "loss_alpha"} == {
        name for name in learner.terms_of(*batches).keys() if name.startswith("loss_")
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", OFFLINE)
def test_a_method_that_learns_from_real_data_alone_has_no_simulator(compose, tmp_path, name, monkeypatch):
    cfg, real = compose("updates=20", "keep=best_in_simulator", config="train")
    monkeypatch.delattr(HybridReplayBuffer, "extend")
    monkeypatch.delattr("torchrl_h2o.training.task.Task.make_simulator")
    policy, training = train(METHODS[name], cfg, real, tmp_path)
    assert "return_trial" not in training.rows[-1]
    kept = load_policy(cfg, tmp_path, METHODS[name].title)
    torch.testing.assert_close(kept.state_dict(), policy.state_dict())


def test_cql_s_loss_sees_actions_in_units_of_their_bounds_and_its_policy_acts_in_the_task_s(compose):
    learner, (batch,) = parts("cql", compose)
    asked = batch["action"].clone()
    learner.terms_of(batch)
    torch.testing.assert_close(batch["action"], asked / 3.0)  # 3 N·m
    with torch.no_grad():
        learner.actor.module[0].module[0][-1].bias[0] = 100.0
    assert learner.actor(batch)["action"].min() > 2.99
