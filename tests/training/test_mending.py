"""The option ``mend``: the run's own data, one search for the same data, and simulators with what was found."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs import GymEnv

from tests.composed import composed
from tests.small_runs import ROBOT, SMALL, run
from torchrl_h2o.effects import ActionDelay, Gravity
from torchrl_h2o.envs import mujoco_model
from torchrl_h2o.options import RunOptions, check_options
from torchrl_h2o.residuals import Report
from torchrl_h2o.residuals.report.contents import (
    NOT_EXPLAINED,
    DataSummary,
    FoundEffect,
    IndistinguishableGroup,
    Verdict,
)
from torchrl_h2o.residuals.report.errors import ErrorSummary
from torchrl_h2o.training import cache, mending
from torchrl_h2o.training.cache import cache_folder
from torchrl_h2o.training.config_file import load_config, save_config
from torchrl_h2o.training.environments import simulator_maker, task_of
from torchrl_h2o.training.judging import table_of_population, table_of_run, write_summary
from torchrl_h2o.training.mending import (
    BLOCK,
    MOST_ROWS,
    POSTERIOR_WORLDS,
    find_missing_effects,
    prepare_mending,
    report_of_run,
    search_key,
    searched_rows,
)
from torchrl_h2o.training.returns import Evaluation
from torchrl_h2o.training.task import Task

PENDULUM = {
    "name": "InvertedPendulum-v5",
    "make": {"_target_": "torchrl.envs.GymEnv", "env_name": "InvertedPendulum-v5"},
    "batched": False,
    "simulator": [],
    "reality": [],
    "seconds_per_step": 0.04,
}


def found(*effects, others=()):
    """A report as a search would write it, with an interval of ± 4 % of each value."""
    parts = [
        FoundEffect(e, True, {n: (0.96 * p.value, 1.04 * p.value) for n, p in e.parameters.items()}, 0.1)
        for e in effects
    ]
    groups = (IndistinguishableGroup((effects[0], *others), (0.1,) * (1 + len(others))),) if others else ()
    return Report(
        simulator="made up",
        data=DataSummary("recorded, all 200 rows", 200, 60),
        error=ErrorSummary("one-step RMSE", "1", 1.0, 0.1),
        found=tuple(parts),
        indistinguishable=groups,
    )


@pytest.fixture
def pendulum(tmp_path, monkeypatch):
    """A task whose simulator has twice the gravity of its data, with the folder of its run and an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    torch.manual_seed(0)
    real = GymEnv("InvertedPendulum-v5").rollout(400, break_when_any_done=False)
    task = Task.from_config(OmegaConf.create(PENDULUM), gap="gravity")
    (tmp_path / "run").mkdir()
    cfg = OmegaConf.create({"mend": True, "mended": None, "data": "swing", "num_worlds": 1, "seed": 0, "env": PENDULUM})
    return cfg, task, real, tmp_path / "run"


def cached(pendulum_task, real):
    """The folder of the cache for a search."""
    return cache_folder() / "mended" / key_of(pendulum_task, real)


def key_of(task, real):
    """The key of a search in the cache."""
    return search_key(task, task.make_simulator(), real)


def new_folder(folder, name):
    (folder.parent / name).mkdir()
    return folder.parent / name


@pytest.mark.slow
def test_the_run_s_data_mend_its_simulator(pendulum):
    cfg, task, real, folder = pendulum
    cfg.mended = find_missing_effects(cfg, task, real, folder)
    assert mujoco_model(task.make_simulator()).opt.gravity[2] == pytest.approx(-19.62)
    assert mujoco_model(task.mended(cfg.mended).make_simulator()).opt.gravity[2] == pytest.approx(-9.81, rel=1e-3)
    assert {path.name for path in (folder / "mended").iterdir()} == {"report.json", "report.html"}
    report = report_of_run(folder)
    assert report.error.after < 0.01 * report.error.before
    assert report.data.source == "swing, all 400 rows"
    assert sorted(path.name for path in folder.iterdir()) == ["mended"]  # nothing temporary is left


def test_the_same_data_are_searched_once(pendulum):
    cfg, task, real, folder = pendulum
    few = real[:50]  # too few for a conclusion, so the search ends at once
    assert find_missing_effects(cfg, task, few, folder) is None
    assert Report.load(cached(task, few)) == report_of_run(folder)
    # a second run reads what the cache holds, here another report in the place of the first
    for path in cached(task, few).iterdir():
        path.unlink()
    found(Gravity(0.5)).save(cached(task, few))
    second = find_missing_effects(cfg, task, few.clone(), new_folder(folder, "second"))
    assert second["effects"] == [{"effect": "Gravity", "scale": 0.5}]
    assert (folder.parent / "second" / "mended" / "report.html").exists()
    assert find_missing_effects(cfg, task, real[:49], new_folder(folder, "other")) is None


def doubted(*effects):
    """A report that advises against its effects."""
    return replace(found(*effects), verdict=Verdict(NOT_EXPLAINED, ("they do not lower the error",), recommended=False))


def test_effects_that_the_report_does_not_recommend_are_left_out(pendulum, capsys):
    cfg, task, real, folder = pendulum
    doubted(Gravity(0.5)).save(folder / "mended")
    assert find_missing_effects(cfg, task, real, folder) is None
    written = capsys.readouterr().out
    assert "is not recommended" in written
    assert written.endswith("The run trains in the unchanged simulator.\n")


@pytest.mark.parametrize(
    ("report", "said"),
    [
        (doubted(Gravity(0.5)), "does not recommend its effects for training: they do not lower the error"),
        (replace(found(Gravity(0.5)), unfinished="action noise was looked for"), "the search was not finished"),
        (found(Gravity(0.5)), ""),
    ],
)
def test_a_report_that_advises_against_its_effects_is_named(compose, tmp_path, capsys, report, said):
    cfg, _ = compose(f"mend={report.save(tmp_path)}", config="h2o_plus")
    prepare_mending(cfg)
    written = capsys.readouterr().out
    assert said in written
    assert bool(written) == bool(said)


def test_data_simulator_and_settings_tell_searches_apart(pendulum, monkeypatch):
    _, task, real, _ = pendulum
    one = key_of(task, real)
    assert key_of(task, real.clone()) == one
    changed, estimated, several = real.clone(), real.clone(), real.clone()
    changed["next", "observation"][7, 1] += 1e-6
    estimated["observation_std"] = torch.full_like(real["observation"], 0.1)
    several["log"] = (torch.arange(len(real)) >= 200).long()
    others = {key_of(task, rows) for rows in (changed, estimated, several)}
    others |= {key_of(replace(task, simulator=effects), real) for effects in ((), (Gravity(1.9),), (ActionDelay(0.1),))}
    monkeypatch.setitem(mending.SEARCH, "held_out", 0.4)
    others.add(key_of(task, real))
    assert len(others) == 7
    assert one not in others


def test_the_model_and_the_code_tell_searches_apart(pendulum, monkeypatch, tmp_path):
    _, task, real, _ = pendulum
    one = key_of(task, real)
    simulator = task.make_simulator()
    mujoco_model(simulator).geom_size[-1, 0] *= 1.01  # as if the user had edited the model's file
    assert search_key(task, simulator, real) != one
    (tmp_path / "residuals").mkdir()
    (tmp_path / "residuals" / "fit.py").write_text("tolerance = 1")
    monkeypatch.setattr(cache.torchrl_h2o, "__file__", str(tmp_path / "__init__.py"))
    keys = []
    for code in ("tolerance = 1", "tolerance = 2", "tolerance = 1"):
        (tmp_path / "residuals" / "fit.py").write_text(code)
        cache._code_of.cache_clear()
        keys.append(key_of(task, real))
    cache._code_of.cache_clear()
    assert one not in keys
    assert keys[0] == keys[2] != keys[1]


def test_a_resumed_run_reads_the_report_in_its_folder(pendulum):
    cfg, task, real, folder = pendulum
    found(Gravity(0.5)).save(folder / "mended")
    cfg.mended = find_missing_effects(cfg, task, real, folder)
    assert cfg.mended["effects"] == [{"effect": "Gravity", "scale": 0.5}]
    assert find_missing_effects(cfg, task, real, folder) == cfg.mended
    assert not cached(task, real).exists()


def test_effects_survive_the_file_of_the_configuration_exactly(pendulum):
    cfg, task, real, folder = pendulum
    found(Gravity(0.5000000123), ActionDelay(1e-7 / 3)).save(folder / "mended")
    cfg.mended = find_missing_effects(cfg, task, real, folder)
    save_config(cfg, folder)
    again = task.mended(load_config(folder).mended)
    assert again.simulator[-2:] == (Gravity(0.5000000123), ActionDelay(1e-7 / 3))


def assert_nothing_is_added(cfg, task, real, folder, said, printed):
    cfg.mended = find_missing_effects(cfg, task, real, folder)
    assert cfg.mended is None
    assert task.mended(cfg.mended) == task
    printed = printed.readouterr().out
    assert said in printed
    assert "trains in the unchanged simulator" in printed
    write_summary(folder, {})
    summary = json.loads((folder / "summary.json").read_text())["mended"]
    assert summary["effects"] == []
    assert said in summary["sentence"]


def test_a_search_that_fails_is_recorded_and_does_not_end_the_run(pendulum, capsys):
    cfg, task, real, folder = pendulum
    narrow = real.clone()
    for part in (narrow, narrow["next"]):
        part["observation"] = part["observation"][:, :3]
    assert_nothing_is_added(cfg, task, narrow, folder, "the search failed (DataError: ", capsys)
    assert not cached(task, narrow).exists()  # the next run tries again


def test_a_defect_of_the_search_ends_the_run(pendulum, monkeypatch):
    cfg, task, real, folder = pendulum

    def close_the_loop(*_, **__):
        raise AttributeError("a defect")

    monkeypatch.setattr(mending, "close_the_loop", close_the_loop)
    with pytest.raises(AttributeError, match="a defect"):
        find_missing_effects(cfg, task, real, folder)
    assert not (folder / "mended").exists()  # the same command searches again


def test_too_few_rows_are_refused_without_an_error(pendulum, capsys):
    cfg, task, real, folder = pendulum
    assert_nothing_is_added(cfg, task, real[:50], folder, "No conclusion: ", capsys)


def test_if_nothing_is_missing_the_run_says_so(pendulum, capsys):
    cfg, task, real, folder = pendulum
    found().save(folder / "mended")
    assert_nothing_is_added(cfg, task, real, folder, "Nothing is missing", capsys)


def test_long_data_are_searched_in_blocks_from_beginning_to_end(pendulum):
    *_, real, _ = pendulum
    assert searched_rows(real) is real
    many = torch.cat([real] * (MOST_ROWS // len(real) + 20)).clone()
    many["time"] = torch.arange(len(many), dtype=torch.float64)[:, None]
    rows = searched_rows(many)
    assert len(rows) == MOST_ROWS
    time = rows["time"].flatten()
    assert (time[0], time[-1]) == (0, len(many) - 1)
    assert ((time.diff() == 1).sum(), (time.diff() > 0).all()) == (MOST_ROWS - MOST_ROWS // BLOCK, True)


def test_mending_comes_after_the_gap_in_every_simulator_of_the_run(compose, tmp_path):
    cfg, real = compose("gap=gravity", "mend=true", config="h2o_plus")
    found(Gravity(0.5)).save(tmp_path / "mended")
    cfg.mended = find_missing_effects(cfg, task_of(cfg), real, tmp_path)
    alone = task_of(cfg).make_simulator()
    assert mujoco_model(alone).opt.gravity[2] == pytest.approx(-9.81)
    for batched in (task_of(cfg).make_simulator(3), simulator_maker(cfg)()):
        assert [m.opt.gravity[2] for m in batched.base_env.models] == pytest.approx([-9.81] * batched.num_worlds)
    assert mujoco_model(task_of(cfg).make_reality()).opt.gravity[2] == pytest.approx(-9.81)


def test_each_world_of_the_collection_has_a_draw_and_evaluations_the_best_values(compose, tmp_path):
    cfg, real = compose("gap=gravity", "mend=posterior", config="h2o_plus")
    prepare_mending(cfg)
    found(Gravity(0.5), others=(ActionDelay(0.01),)).save(tmp_path / "mended")
    cfg.mended = find_missing_effects(cfg, task_of(cfg), real, tmp_path)
    task = task_of(cfg)
    simulator = task.make_training_simulator(cfg.num_worlds)
    pulls = [model.opt.gravity[2] for model in simulator.base_env.models]
    assert len(pulls) == POSTERIOR_WORLDS
    assert set(pulls) > {-19.62}  # worlds with the delay in place of the lower gravity
    others = np.array([pull for pull in pulls if pull != -19.62])
    assert len(set(others)) == len(others)
    assert others == pytest.approx(-9.81, rel=0.08)
    assert simulator.rollout(3)["next", "reward"].shape == (POSTERIOR_WORLDS, 3, 1)
    for evaluated in (task.make_simulator(2), task.make_simulator(POSTERIOR_WORLDS)):
        assert {model.opt.gravity[2] for model in evaluated.base_env.models} == {-9.81}
    found(Gravity(0.5), others=(ActionDelay(0.01),)).save(tmp_path / "again" / "mended")
    before = cfg.mended
    cfg.mended = None
    assert find_missing_effects(cfg, task_of(cfg), real, tmp_path / "again") == before


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["mend=posterior", "env.batched=false"], "is not batched: use mend=true"),
        (["mend=posterior", "num_worlds=12"], "a multiple of 12"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(overrides, said):
    cfg = composed("h2o_plus", *overrides)
    with pytest.raises(ValueError, match=said):
        check_options(cfg, RunOptions)


def test_without_mend_nothing_changes(compose, tmp_path):
    cfg, real = compose(config="h2o_plus")
    prepare_mending(cfg)
    assert cfg.num_worlds == 4
    assert find_missing_effects(cfg, task_of(cfg), real, tmp_path) is None
    assert not list(tmp_path.iterdir())


def test_the_end_of_a_run_shows_what_was_found_and_then_the_returns(tmp_path):
    result = Evaluation([1.0], [10])
    assert table_of_run({"H2O+": result}, tmp_path, None, 0.1).startswith("\nin reality")
    for name in ("seed_0", "seed_1"):
        found(Gravity(0.5)).save(tmp_path / name / "mended")
    lines = table_of_run({"H2O+": result}, tmp_path / "seed_0", None, 0.1).splitlines()
    assert lines[1] == "Your simulator lacks: gravity × 0.5; one-step error 1 → 0.1 (−90 %)."
    assert lines[4].startswith("in reality")
    table = table_of_population({"seed_0": result, "seed_1": result}, tmp_path, 0.1)
    assert table.count("Your simulator lacks") == 1


def test_a_population_names_the_member_that_was_best_in_the_simulator(tmp_path):
    result = Evaluation([1.0], [10])
    of_each = {"seed_0": result, "seed_1": result, "seed_2": None}
    assert "use " not in table_of_population(of_each, tmp_path, 0.1, {"seed_0": None, "seed_1": None})
    table = table_of_population(of_each, tmp_path, 0.1, {"seed_0": 10.0, "seed_1": 20.0})
    assert "use        seed_1, the best in the simulator: 20" in table
    assert table.endswith("/seed_1")


@pytest.mark.slow
def test_a_posterior_run_collects_in_its_draws_and_is_resumed_and_evaluated_like_any_other(command, tmp_path):
    out = tmp_path / "out"
    found(Gravity(0.5), others=(ActionDelay(0.01),)).save(out / "mended")
    chosen = [*SMALL, *ROBOT, "updates=20", "gap=gravity", "mend=posterior", "hydra.run.dir=out"]
    printed = run(command(*chosen))
    assert f"num_worlds={POSTERIOR_WORLDS} instead of 4" in printed
    assert printed.count("Your simulator lacks") == 2
    saved = load_config(out)
    assert len(saved.mended.worlds) == saved.num_worlds == POSTERIOR_WORLDS
    assert "Your simulator lacks" in run(command("resume=out"))
    assert load_config(out) == saved
    assert "H2O+ in simulator" in run(
        command("checkpoint=out", "in=simulator", "episodes=1", "film=null", script="evaluate.py")
    )
    assert json.loads((out / "summary.json").read_text())["mended"]["error"]["after"] == 0.1


@pytest.mark.slow
def test_one_command_mends_trains_and_reports_both(command, tmp_path):
    """The real log is too short for a conclusion, which is a result as well: the run trains and says so."""
    small = [*SMALL, *ROBOT, "updates=20", "env.recording.num_transitions=150", "mend=true"]
    for script, more in (("h2o_plus.py", []), ("train.py", ["method=sac"]), ("train.py", ["seeds=[0,1]"])):
        out = Path(script).stem + str(len(more) and more[0][0])
        printed = run(command(*small, *more, f"hydra.run.dir={out}", script=script))
        assert printed.count("No conclusion") >= 2  # before the training and at its end
        for path in (tmp_path / out).rglob("summary.json"):
            summary = json.loads(path.read_text())
            assert summary["mend"] is True
            assert summary["mended"]["conclusion"]
            assert summary["return_real"]
        assert list((tmp_path / out).rglob("mended/report.html"))
