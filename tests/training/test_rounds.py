"""Rounds between a simulator and reality: the predicted interval, the run in reality, and what its log shows."""

from dataclasses import replace

import pytest
import torch

from torchrl_h2o.data.readers.ted import require_ted
from torchrl_h2o.effects import ActionDelay, BodyMass, Gravity, effect_to_dict
from torchrl_h2o.envs import noisy_balance_controller
from torchrl_h2o.objectives import make_actor
from torchrl_h2o.residuals import Report
from torchrl_h2o.residuals.report.contents import EXPLAINED, DataSummary, FoundEffect, Verdict
from torchrl_h2o.training import rounds
from torchrl_h2o.training.environments import task_of
from torchrl_h2o.training.mending import find_missing_effects
from torchrl_h2o.training.rounds import (
    PREDICTED,
    Round,
    draw_rounds,
    predict_return,
    run_in_reality,
    table_of_rounds,
    what_is_lacking,
)
from torchrl_h2o.training.task import Task

ONE = Round(2.5, ("gravity × 0.5",), predicted=10.0, low=5.0, high=20.0, measured=20.0, lasted=1.0)
MISSED = replace(ONE, seconds=3.5, measured=21.0).lacking("most in x, between 1 and 2 s")


@pytest.fixture
def robot(compose):
    """A short round on the robot: its configuration and its first data."""
    cfg, real = compose("mend=posterior", config="sim_to_real")
    return cfg, real.set("log", torch.zeros(len(real), dtype=torch.int64))


def policy_of(cfg):
    torch.manual_seed(0)
    return make_actor(4, task_of(cfg).make_reality().action_spec, cfg.num_cells)


def test_a_return_at_the_end_of_the_interval_is_inside_and_one_beyond_is_not():
    assert ONE.is_inside
    assert ONE.to_json()["inside"] is True
    assert not MISSED.is_inside
    assert not replace(ONE, measured=4.9).is_inside


def test_the_table_shows_the_interval_what_was_found_and_what_is_lacking_where_it_missed():
    lines = table_of_rounds([ONE, MISSED]).strip().splitlines()
    assert len(lines) == 6
    assert lines[1].split() == ["2.5", "s", "10", "[5,", "20]", "20", "1.0", "s"]
    assert lines[2].strip() == "found: gravity × 0.5"
    assert lines[3].endswith("outside")
    assert lines[5].strip() == "outside: most in x, between 1 and 2 s"


def test_the_figure_is_written(tmp_path):
    draw_rounds(tmp_path / "rounds.png", [ONE, MISSED], "robot")
    assert (tmp_path / "rounds.png").stat().st_size > 10_000


def test_a_prediction_draws_its_own_worlds_from_the_report(robot, tmp_path, monkeypatch):
    cfg, real = robot
    delay = FoundEffect(ActionDelay(0.01), True, {"delay": (0.008, 0.012)}, 0.1)
    Report(simulator="robot", data=DataSummary("swing", 100, 25), found=(delay,), verdict=Verdict(EXPLAINED)).save(
        tmp_path / "mended"
    )
    cfg.mended = find_missing_effects(cfg, task_of(cfg), real, tmp_path)
    drawn, make = [], Task.make_training_simulator

    def spied(self, *arguments):
        drawn.append(self.worlds)
        return make(self, *arguments)

    monkeypatch.setattr(Task, "make_training_simulator", spied)
    predicted = predict_return(cfg, policy_of(cfg), tmp_path)
    assert len(predicted.returns) == PREDICTED == len(drawn[0]) == len({delay.delay for (delay,) in drawn[0]})
    assert all(0.004 < delay.delay < 0.016 for (delay,) in drawn[0])
    assert not set(drawn[0]) & set(task_of(cfg).worlds)


def test_a_run_in_reality_gives_a_log_in_physical_units_that_is_recorded_once(robot, tmp_path):
    cfg, real = robot
    policy = policy_of(cfg)
    log = run_in_reality(cfg, policy, tmp_path, real)
    require_ted(log, source="log")
    assert set(log.keys(True, True)) == set(real.keys(True, True))
    assert 0 < len(log) <= 40
    assert log["next", "done"].flatten().nonzero().tolist() == [[len(log) - 1]]
    assert log["log"].unique().tolist() == [1]
    torch.manual_seed(3)
    replayed, env = task_of(cfg).make_reality(), []
    current = replayed.set_seed(rounds.REALITY_SEED + 1) and replayed.reset()
    for action in log["action"]:
        env.append(current["observation"])
        current = replayed.step_mdp(replayed.step(current.set("action", action)))
    assert torch.allclose(torch.stack(env), log["observation"], atol=1e-5)
    again = run_in_reality(cfg, make_actor(4, replayed.action_spec, [4]), tmp_path, real)
    assert (again == log).all()
    second = run_in_reality(cfg, policy, tmp_path / "round_2", torch.cat([real, log]))
    assert second["log"].unique().tolist() == [2]
    assert (second["observation"][0] != log["observation"][0]).any()  # another start


@pytest.fixture
def standing(compose):
    """The robot under its controller: 300 rows of data and 300 of a second log, in a task with given effects."""

    def build(*effects):
        cfg, _ = compose("env.make.max_episode_steps=300", config="sim_to_real")
        cfg.env.reality = []
        cfg.mended = {"effects": [effect_to_dict(effect) for effect in effects], "worlds": None}
        reality = task_of(cfg).make_reality()
        controller = noisy_balance_controller(task="standing_still")
        logs = []
        for number in (0, 1):
            torch.manual_seed(number)
            reality.set_seed(number)
            log = reality.rollout(300, controller)
            logs.append(log.set("log", torch.full((len(log),), number)))
        return cfg, *logs

    return build


def test_the_log_of_a_run_says_where_the_simulator_is_wrong(standing):
    assert what_is_lacking(*standing(BodyMass(1.5, bodies="torso"))).startswith(
        "the simulator lacks something, most in "
    )


def test_the_log_of_a_run_shows_no_difference_from_the_right_simulator(standing):
    assert what_is_lacking(*standing()).startswith("its log shows no difference from the simulator. ")


def test_a_log_that_does_not_fit_the_simulator_is_said(standing, monkeypatch):
    cfg, real, log = standing(Gravity(0.5))
    monkeypatch.setattr(rounds, "close_the_loop", lambda *a, **k: (_ for _ in ()).throw(ValueError("too short")))
    assert what_is_lacking(cfg, real, log) == "its log cannot be compared with the simulator (too short)"
