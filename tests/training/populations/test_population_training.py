"""A population as a command: one folder per member, and each member learns and resumes as a single run does."""

import json

import pytest

from tests.small_runs import ROBOT, SMALL, rows, run, trained
from torchrl_h2o.data import HybridReplayBuffer
from torchrl_h2o.data.transition_checks import UnstableSimulatorError
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.loop import Trainee, train
from torchrl_h2o.training.methods.h2o_plus import H2O_PLUS, make_learner
from torchrl_h2o.training.populations.job import run_population
from torchrl_h2o.training.populations.learner import PopulationLearner
from torchrl_h2o.training.populations.loop import PopulationTraining, members_of, train_population

SMALLER = ["updates=30", "updates_per_epoch=10", "steps_per_epoch=20", "lr_end_factor=0.1", "keep=last"]


@pytest.fixture
def compose(compose):
    return lambda *overrides: compose(*SMALLER, *overrides)


def train_all(cfg, real, directory):
    return train_population(make_learner, cfg, members_of(cfg), real, directory)


def test_every_combination_is_a_member_with_a_name(compose):
    cfg, _ = compose("seeds=[0,3]", "gaps=[gravity,null]")
    members = members_of(cfg)
    assert list(members) == ["seed_0_gravity", "seed_0_no_gap", "seed_3_gravity", "seed_3_no_gap"]
    assert [(own.seed, own.gap) for own in members.values()] == [(0, "gravity"), (0, None), (3, "gravity"), (3, None)]
    assert all(members_of(own) == {} for own in members.values())
    assert members_of(compose()[0]) == {}


@pytest.mark.slow
def test_each_member_learns_with_its_own_settings(compose, tmp_path):
    """Its discriminators become about as accurate as those of a single run from the same networks."""
    cfg, real = compose("updates=200", "updates_per_epoch=100", "seeds=[0,1]", "gaps=[null,gravity]")
    outcomes = train_all(cfg, real, tmp_path / "population")
    assert len({outcome.rows[-1]["loss_qvalue"] for outcome in outcomes.values()}) == 4
    name = "seed_0_gravity"
    _, training = train(H2O_PLUS, members_of(cfg)[name], real, tmp_path / name)
    for figure, tolerance in (("accuracy", 0.2), ("ratio_of_sim", 0.5)):
        mine, alone = ([row[figure] for row in rows] for rows in (outcomes[name].rows, training.rows))
        assert mine != alone  # other random numbers
        assert mine == pytest.approx(alone, abs=tolerance), figure


@pytest.mark.slow
def test_an_interrupted_population_goes_on_as_an_unbroken_one(compose, tmp_path, monkeypatch):
    cfg, real = compose("seeds=[0,1]", "keep=best_in_simulator")
    train_all(cfg, real, tmp_path / "whole")
    log = PopulationTraining.log_member

    def interrupt(self, epoch, member, **metrics):
        if (epoch, member) == (1, "seed_1"):
            raise KeyboardInterrupt
        log(self, epoch, member, **metrics)

    closed, close = [], Trainee.close
    monkeypatch.setattr(
        "torchrl_h2o.training.loop.Trainee.close", lambda self: (closed.append(self.cfg.seed), close(self))
    )
    monkeypatch.setattr("torchrl_h2o.training.populations.loop.PopulationTraining.log_member", interrupt)
    with pytest.raises(KeyboardInterrupt):
        train_all(cfg, real, tmp_path / "parts")
    monkeypatch.undo()
    assert sorted(closed) == [0, 1]  # the workers of all members are closed
    assert trained(tmp_path / "parts") != trained(tmp_path / "whole")
    train_all(cfg, real, tmp_path / "parts")
    assert trained(tmp_path / "parts") == trained(tmp_path / "whole")
    for member in ("seed_0", "seed_1"):
        assert rows(tmp_path / "parts" / member) == rows(tmp_path / "whole" / member)


def break_seed_1(monkeypatch, at_epoch):
    """Makes the simulated rewards of seed 1 NaN from an epoch on; returns the list of simulated (seed, epoch)."""
    begin_epoch, simulated = Trainee.begin_epoch, []

    def broken(self, epoch):
        begin_epoch(self, epoch)
        simulated.append((self.cfg.seed, epoch))
        if self.cfg.seed == 1 and epoch >= at_epoch:
            self.learner.replay.storage[:]["next", "reward"].fill_(float("nan"))

    monkeypatch.setattr("torchrl_h2o.training.loop.Trainee.begin_epoch", broken)
    return simulated


@pytest.mark.slow
def test_a_member_that_fails_is_reported_and_the_others_go_on_as_if_it_had_not(compose, tmp_path, monkeypatch):
    cfg, real = compose("seeds=[0,1,2]")
    healthy = train_all(cfg, real, tmp_path / "healthy")
    simulated = break_seed_1(monkeypatch, at_epoch=1)
    outcomes = train_all(cfg, real, tmp_path / "broken")
    failed = outcomes["seed_1"]
    assert [epoch for seed, epoch in simulated if seed == 1] == [0, 1]
    assert failed.failure == {"updates": 10, "why": "loss_qvalue not finite"}
    assert failed.updates == 10
    assert len(failed.rows) == 1
    assert all(parameter.isfinite().all() for parameter in failed.policy.parameters())
    for name in ("seed_0", "seed_2"):
        assert outcomes[name].failure is None
        assert outcomes[name].rows == healthy[name].rows
    again = train_all(cfg, real, tmp_path / "broken")  # resumes from the last checkpoint, which stores the failure
    assert again["seed_1"].failure == failed.failure
    assert again["seed_0"].rows == healthy["seed_0"].rows


@pytest.mark.slow
def test_a_member_whose_simulator_is_unstable_stops_and_the_others_go_on(compose, tmp_path, monkeypatch):
    cfg, real = compose("seeds=[0,1]", "updates=20")
    healthy = train_all(cfg, real, tmp_path / "healthy")
    extend, calls = HybridReplayBuffer.extend, []

    def unstable(self, transitions):
        calls.append(self)
        if len(calls) == unstable_call:
            transitions["next", "reward"][0, 3] = float("nan")
        extend(self, transitions)

    monkeypatch.setattr(HybridReplayBuffer, "extend", unstable)
    unstable_call = 4  # of the second member in the second epoch
    outcomes = train_all(cfg, real, tmp_path / "unstable")
    assert outcomes["seed_1"].failure["updates"] == 10
    assert "reward') that is NaN or infinite in 1 of 20 rows" in outcomes["seed_1"].failure["why"]
    assert outcomes["seed_0"].rows == healthy["seed_0"].rows
    calls.clear()
    unstable_call = 2  # before it has any simulated row
    with pytest.raises(UnstableSimulatorError, match=r"^seed_1: the simulator produced"):
        train_all(cfg, real, tmp_path / "at_once")


@pytest.mark.slow
def test_a_member_that_failed_is_neither_evaluated_nor_left_out_of_the_table(compose, tmp_path, monkeypatch, capsys):
    cfg, _ = compose("seeds=[0,1]", "updates=10")
    update = PopulationLearner.update

    def spoiling(self):
        terms = update(self)
        if self.updates == 10:  # its losses are finite up to this update
            for parameter in self.population.parameters():
                parameter.data[1] = float("inf")
        return terms

    monkeypatch.setattr("torchrl_h2o.training.populations.learner.PopulationLearner.update", spoiling)
    with pytest.raises(DivergenceError, match=r"1 of 2 members diverged: seed_1 after 10 updates .*parameters"):
        run_population(cfg, members_of(cfg), tmp_path)
    failed = json.loads((tmp_path / "seed_1" / "summary.json").read_text())
    assert (failed["failure"], failed["updates"], failed["return_real"]) == ("its parameters not finite", 10, None)
    assert not (tmp_path / "seed_1" / "metrics.csv").exists()
    assert not list((tmp_path / "seed_1").glob("checkpoints/*/checkpoint*"))  # its policy is not finite
    healthy = json.loads((tmp_path / "seed_0" / "summary.json").read_text())
    assert healthy["return_real"]["episodes"] == 1
    table = {line.split()[0]: line.split()[1] for line in capsys.readouterr().out.splitlines() if "seed_" in line}
    assert table["seed_1"] == "failed"
    assert float(table["seed_0"])


@pytest.mark.slow
def test_one_command_leaves_a_folder_a_member_and_one_table(command, tmp_path):
    small = [*SMALL, *ROBOT, *SMALLER, "updates=10", "hydra.run.dir=out"]
    printed = run(command(*small, "seeds=[0,1]", "gaps=[gravity]", script="train.py"))
    for name, seed in (("seed_0_gravity", 0), ("seed_1_gravity", 1)):
        summary = json.loads((tmp_path / "out" / name / "summary.json").read_text())
        assert (summary["seed"], summary["gap"], summary["updates"]) == (seed, "gravity", 10)
        assert summary["return_real"].keys() >= {"mean", "std", "episodes"}
        assert (tmp_path / "out" / name / "learning_curve.png").stat().st_size > 10_000
        assert name in printed
    assert "the data's behaviour" in printed

    replayed = run(command("checkpoint=out/seed_1_gravity", "episodes=1", "film=null", script="evaluate.py"))
    assert "H2O+ in reality" in replayed
