"""The paper's grids: their runs, and that no result is lost when a grid is killed or a run fails."""

import csv
import shlex
import signal
import subprocess
from collections import Counter
from importlib.util import find_spec
from types import SimpleNamespace

import hydra
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import open_dict
from torchrl.checkpoint import CheckpointRotation

from tests.small_runs import ROBOT, ROOT, SMALL, trained
from torchrl_h2o.comparison.grids import FIGURES, TABLES, check_overrides, chosen_grid
from torchrl_h2o.comparison.launching import GridLauncher
from torchrl_h2o.comparison.options import PaperOptions
from torchrl_h2o.comparison.results_file import (
    CURVE,
    IDENTITY,
    RESULT,
    adopt_runs,
    append_rows,
    identity,
    read_rows,
    repeating_command,
)
from torchrl_h2o.data import write_ted
from torchrl_h2o.data.transition_checks import UnstableSimulatorError
from torchrl_h2o.options import check_options
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS


def chosen(runs, key):
    values = [override.partition("=")[2] for run in runs for override in run if override.startswith(f"{key}=")]
    return Counter(values)


def paper(*overrides):
    with hydra.initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        return hydra.compose("paper", list(overrides))


def test_the_main_table_has_every_cell_once_and_methods_without_simulator_once_a_data_set():
    runs = list(TABLES["returns"].runs((0, 1)))
    assert len(runs) == 2 * (25 * 4 + 3 * 2)
    assert chosen(runs, "method") == {"sac": 50, "darc": 50, "h2o": 50, "h2o_plus": 50, "cql": 6, "iql": 6}
    assert len({tuple(run) for run in runs}) == len(runs)
    walker = [run for run in runs if "env=walker2d" in run]
    assert {"gap=long_torso", "gap=soft_feet"}.isdisjoint(override for run in walker for override in run)


def test_the_ablations_are_the_paper_s():
    mixing = list(TABLES["mixing"].runs((0,)))
    assert chosen(mixing, "mixing") == {"0.0": 1, "0.1": 2, "0.2": 1, "0.5": 1, "1.0": 1}
    assert chosen(mixing, "ratio") == {"false": 1}
    assert chosen(TABLES["gaps"].runs((0,)), "gap_strength") == {"1.25": 2, "1.5": 2, "2.0": 2, "3.0": 2}
    assert len(list(FIGURES["backbones"].runs((0,)))) == 8
    assert len(list(FIGURES["wheel_legged"].runs((0,)))) == 12


def test_any_subset_is_an_override():
    cfg = paper("table=returns", "methods=[h2o_plus,iql]", "gaps=[gravity,friction]", "seeds=[0,1]")
    runs = list(chosen_grid(cfg).runs(tuple(cfg.seeds)))
    assert chosen(runs, "method") == {"h2o_plus": 2 * 3 * 2, "iql": 2 * 3}
    assert chosen(runs, "gap") == {"gravity": 6, "friction": 6, "null": 6}


def test_data_sets_are_any_that_have_the_environment_in_their_name_and_tasks_any_environment():
    public, hdf5 = "mujoco/walker2d/expert-v0", "files/halfcheetah_medium-v2.hdf5"
    cfg = paper("table=returns", f"datasets=[{public},{hdf5}]", "gaps=[gravity]", "methods=[sac]")
    runs = list(chosen_grid(cfg).runs((0,)))
    assert [run[1:3] for run in runs] == [["env=walker2d", f"data={public}"], ["env=halfcheetah", f"data={hdf5}"]]
    own = list(chosen_grid(paper("table=methods", "tasks=[mine]")).runs((0,)))
    assert chosen(own, "env") == {"mine": 6}
    assert not chosen(own, "gap")


@pytest.mark.parametrize("overrides", [["table=main"], [], ["table=returns", "figure=backbones"]])
def test_a_grid_that_there_is_not_is_said(overrides):
    with pytest.raises(ValueError, match=r"must be returns, mixing, gaps|name one"):
        check_options(paper(*overrides), PaperOptions)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["table=returns", "methods=[ppo]"], r"methods=\[ppo\]: choose sac, cql"),
        (["table=returns", "datasets=[hopper/medium-v0]"], "its name must contain halfcheetah or walker2d"),
        (["table=methods"], r"name tasks=\[...\]"),
        (["figure=wheel_legged", "gaps=[gravity]"], "has no data sets, so gaps would have no effect"),
    ],
)
def test_a_choice_that_there_is_not_is_said_before_anything_runs(overrides, said):
    with pytest.raises(ValueError, match=said):
        chosen_grid(paper(*overrides))


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["table=returns", "gaps=[gravty]"], r"gaps=\[gravty\]: must be .*did you mean gravity\?"),
        (["table=returns", "methods=iql"], r"methods=iql: must be null or a list of names"),
        (["figure=data_size", "sizes=10"], r"sizes=10: must be null or a list of one or more numbers above 0"),
        (["figure=data_size", "log=missing.txt"], "log=missing.txt: there is no such file"),
        (["table=returns", "seeds=[]"], r"seeds=\[\]: must be a list of one or more integers"),
    ],
)
def test_a_selection_of_another_type_is_refused(overrides, said):
    with pytest.raises(ValueError, match=said):
        check_options(paper(*overrides), PaperOptions)


@pytest.mark.parametrize(
    ("grid", "override", "said"),
    [
        (TABLES["returns"], "gap=friction", r"set gap themselves; choose with gaps="),
        (TABLES["returns"], "+seed=1", r"choose with seeds="),
        (TABLES["returns"], "gap_strength=3", r"choose with strengths="),
        (FIGURES["backbones"], "backbone=sparse", "leave it out, or take another grid"),
    ],
)
def test_what_each_run_says_for_itself_is_no_override_of_all(grid, override, said):
    runs = list(grid.runs((0,)))
    with pytest.raises(ValueError, match=said):
        check_overrides(["updates=10", override], runs)
    check_overrides(["updates=10", "env.make.max_episode_steps=40", "mixing=0.3"], list(TABLES["returns"].runs((0,))))


@pytest.mark.parametrize("grid", [TABLES["mixing"], TABLES["gaps"]])
def test_runs_that_differ_have_different_identities(grid):
    found = []
    for run in grid.runs((0,)):
        cfg = paper(*run)
        cfg.overrides = run
        found.append(tuple(identity(cfg).values()))
    assert len(set(found)) == len(found)
    assert not any("=" in value for who in found for value in who)


def test_every_run_is_an_override_that_hydra_reads():
    parser = OverridesParser.create()
    for grid in (TABLES | FIGURES).values():
        for run in grid.runs((0,)):
            parser.parse_overrides(run)


def test_the_data_size_figure_has_every_method_at_every_size_and_sac_once(tmp_path):
    log = tmp_path / "log.txt"
    log.touch()
    grid = chosen_grid(paper("figure=data_size", f"log={log}"))
    runs = list(grid.runs((0, 1)))
    assert len(runs) == 2 * (4 * 7 + 2 * 7 + 7 + 7 + 2)
    assert len({tuple(run) for run in runs}) == len(runs)
    assert runs[58:] == [[*run[:-1], "seed=1"] for run in runs[:58]]  # all of one seed, then the next
    assert chosen(runs[:58], "env") == {"wheel_legged": 29 + 7, "wheel_legged_forward": 15, "wheel_legged_poor": 7}
    assert chosen(runs[:58], "data_seconds") == {"2.5": 14, "10": 7, "30": 7 + 7}
    assert chosen(runs[:58], "data") == {str(log): 7}
    assert chosen(runs[:58], "mend") == {"true": 16, "posterior": 8}
    plain = [run for run in runs[:58] if "method=sac" in run and "mend=true" not in run]
    assert plain == [["method=sac", f"env={env}", "seed=0"] for env in ("wheel_legged", "wheel_legged_forward")]


def test_a_part_of_the_data_size_figure_is_a_selection():
    cfg = paper("figure=data_size", "tasks=[wheel_legged,wheel_legged_poor]", "methods=[iql,sac]", "sizes=[2.5,83]")
    assert list(chosen_grid(cfg).runs((3,))) == [
        ["method=iql", "env=wheel_legged", "data_seconds=2.5", "seed=3"],
        ["method=sac", "env=wheel_legged", "seed=3"],
        ["method=iql", "env=wheel_legged", "seed=3"],
    ]
    assert not any("data=" in override for run in chosen_grid(paper("figure=data_size")).runs((0,)) for override in run)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["methods=[darc]"], r"methods=\[darc\]: choose iql, cql"),
        (["sizes=[5]"], r"sizes=\[5\]: choose 2.5, 10.0"),
        (["tasks=[log]"], r"log=standing_still.txt"),
        (["gaps=[gravity]"], r"gaps would have no effect"),
    ],
)
def test_a_selection_that_the_data_size_figure_does_not_have_is_said(overrides, said):
    with pytest.raises(ValueError, match=said):
        chosen_grid(paper("figure=data_size", *overrides))


def test_amounts_of_data_are_selections_of_one_figure_only():
    with pytest.raises(ValueError, match="only figure=data_size has amounts of real data: leave out sizes"):
        chosen_grid(paper("figure=wheel_legged", "sizes=[10]"))
    with pytest.raises(ValueError, match=r"choose with sizes="):
        check_overrides(["data_seconds=5"], list(FIGURES["data_size"].runs((0,))))


def test_runs_that_differ_in_their_data_or_in_mending_have_different_identities():
    found = {}
    for run in FIGURES["data_size"].runs((0,)):
        cfg = paper(*(override for override in run if not override.startswith("mend=")))
        with open_dict(cfg):
            cfg.mend = {"mend=true": True, "mend=posterior": "posterior"}.get(run[-2])
            cfg.overrides = run
        found[tuple(run)] = identity(cfg)
    assert len({tuple(who.values()) for who in found.values()}) == len(found) == 51
    assert {who["others"] for who in found.values()} == {""}
    assert Counter((who["data_seconds"], who["mend"]) for who in found.values()) == {
        ("2.5", ""): 8,
        ("2.5", "true"): 4,
        ("10", ""): 4,
        ("10", "true"): 2,
        ("30", ""): 4 + 4,
        ("30", "true"): 2 + 2,
        ("", ""): 5 + 5,
        ("", "true"): 2 + 2,
        ("2.5", "posterior"): 2,
        ("10", "posterior"): 1,
        ("30", "posterior"): 2,
        ("", "posterior"): 2,
    }


GRID = ["figure=wheel_legged", "tasks=[wheel_legged]", "seeds=[0]", *SMALL, *ROBOT, "results=results.csv"]


@pytest.mark.slow
def test_a_grid_is_left_alone_by_a_second_one_and_goes_on_where_it_was_when_killed(command, compose, tmp_path):
    asked = command(*GRID, "methods=[iql,cql]", "updates=200", script="paper.py")
    process = subprocess.Popen(**asked, text=True)
    while not (second := checkpoint_of(tmp_path, "cql")):
        assert process.poll() is None, process.communicate()[0]
    process.send_signal(signal.SIGSTOP)  # a stopped process keeps its lock on the run folder
    beside = subprocess.run(**command(*GRID, "methods=[cql]", "updates=200", "retries=0", script="paper.py"), text=True)
    assert beside.returncode != 0
    assert "RuntimeError: another process is at work in outputs/paper/results/cql__" in beside.stdout

    process.kill()
    process.communicate()
    assert [row["method"] for row in read_rows(tmp_path / "results.csv")] == ["iql"]

    done = subprocess.run(**asked, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "2 runs, 1 of them done" in done.stdout
    assert done.stdout.count("run folder:") == 1
    assert [row["method"] for row in read_rows(tmp_path / "results.csv")] == ["iql", "cql"]

    cfg, real = compose("updates=200", "method=cql", config="train")
    train(METHODS["cql"], cfg, real, tmp_path / "unbroken")
    assert trained(second, "cql") == trained(tmp_path / "unbroken", "cql")

    one = load_config(second)
    assert one.seeds is None  # otherwise h2o_plus.py would resume it as a population
    moved = [*GRID[:-1], "results=elsewhere/results.csv", "methods=[cql]", "updates=200"]
    done = subprocess.run(**command(*moved, script="paper.py"), text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert [row["method"] for row in read_rows(tmp_path / "elsewhere" / "results.csv")] == ["cql"]


@pytest.mark.slow
def test_an_interrupted_grid_says_how_it_goes_on(command, tmp_path):
    asked = command(*GRID, "methods=[cql,iql]", "updates=20000", script="paper.py")
    process = subprocess.Popen(**asked, text=True)
    while not checkpoint_of(tmp_path, "cql"):
        assert process.poll() is None, process.communicate()[0]
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert printed.strip().endswith("interrupted with 2 runs to go; the same command continues with them")


@pytest.mark.slow
@pytest.mark.skipif(find_spec("hydra_plugins.hydra_joblib_launcher") is None, reason="an extra: .[launchers]")
def test_runs_at_once_record_what_runs_in_turn_do(command, compose, tmp_path):
    _, real = compose()
    write_ted(real, tmp_path / "recording")
    launchers = {"in_turn": [], "at_once": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]}
    recorded = []
    for name, overrides in launchers.items():
        folder = [f"results={name}.csv", f"hydra.sweep.dir=outputs/{name}", *overrides]
        small = [*GRID[:-1], "methods=[iql,sac]", "updates=20", "data=recording", *folder]
        done = subprocess.run(**command(*small, script="paper.py"), text=True, check=False)
        assert done.returncode == 0, done.stdout
        rows = sorted(read_rows(tmp_path / f"{name}.csv"), key=lambda row: row["method"])
        recorded.append([(row["method"], row["return_mean"], row["return_std"]) for row in rows])
    assert recorded[0] == recorded[1]
    assert len(recorded[0]) == 2


@pytest.fixture
def grid_of(tmp_path, monkeypatch):
    """Builds a grid whose runs a given launcher carries out."""

    def build(launch):
        launcher = SimpleNamespace(launch=lambda jobs, initial_job_idx: launch(jobs))
        monkeypatch.setattr(GridLauncher, "identity", lambda self, run: identity_of(run))
        monkeypatch.setattr("hydra.core.plugins.Plugins.instantiate_launcher", lambda self, **kwargs: launcher)
        config = hydra.compose("paper", ["figure=wheel_legged"], return_hydra_config=True)
        return GridLauncher(config, tmp_path / "results.csv", shared=[], task=lambda cfg: None)

    with hydra.initialize_config_dir(str(ROOT / "recipes" / "config"), version_base=None):
        yield build


def identity_of(run):
    return dict.fromkeys(IDENTITY, "") | {"method": run[0].partition("=")[2]}


def test_a_run_that_died_once_is_done_by_the_second_try(grid_of):
    """The launcher fails as a whole, as it does when one worker is killed."""
    launched = []

    def launch(jobs):
        launched.append(len(jobs))
        if len(launched) == 1:
            raise RuntimeError("a worker was killed")
        for number, _ in enumerate(jobs):
            who = identity_of([f"method={number}"])
            append_rows(grid.results, (*IDENTITY, *RESULT), [dict.fromkeys(RESULT, "1") | who], who)
        return [SimpleNamespace(return_value=None) for _ in jobs]

    grid = grid_of(launch)
    assert grid.run([["method=0"], ["method=1"]], retries=1) == []
    assert launched == [2, 2]


@pytest.mark.parametrize(
    "error", [UnstableSimulatorError("the simulator diverged"), DivergenceError("loss_pi", "", None)]
)
def test_a_run_that_would_diverge_again_is_not_retried(grid_of, error):
    class Failed:
        def __init__(self, error):
            self.error = error

        @property
        def return_value(self):
            raise self.error

    launched = []

    def launch(jobs):
        launched.append([override for override in jobs[0] if "method" in override])
        return [Failed(error if job[0] == "method=0" else OSError("the disk is full")) for job in jobs]

    first, second = grid_of(launch).run([["method=0"], ["method=1"]], retries=1)
    assert launched == [["method=0"], ["method=1"]]
    assert f"method=0: {type(error).__name__}: {error}" in first
    assert "method=1: OSError: the disk is full" in second


def test_a_run_that_another_group_has_done_is_taken_over_with_its_curve(tmp_path):
    who = dict.fromkeys(IDENTITY, "x")
    for name, columns in (("a.csv", (*IDENTITY, *RESULT)), ("a_curves.csv", (*IDENTITY, *CURVE))):
        rows = [dict.fromkeys(columns, "1") | whose for whose in (who, who | {"seed": "y"})]
        for row in rows:
            append_rows(tmp_path / name, columns, [row], row)
    (tmp_path / "notes.csv").write_bytes(b"anybody's\xff, x\n")
    (tmp_path / "empty.csv").touch()
    for _ in range(2):
        adopt_runs(tmp_path / "b.csv", [who, who | {"seed": "z"}])
    assert [row["seed"] for row in read_rows(tmp_path / "b.csv")] == ["x"]
    assert [row["seed"] for row in read_rows(tmp_path / "b_curves.csv")] == ["x"]


def test_results_of_an_earlier_version_without_some_columns_are_kept(tmp_path):
    columns = [column for column in (*IDENTITY, *RESULT) if column not in ("data_seconds", "mend", "mean_v")]
    old = dict.fromkeys(columns, "1")
    with open(tmp_path / "a.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerow(old)
    new = dict.fromkeys((*IDENTITY, *RESULT), "1") | {"mend": "", "data_seconds": "2.5"}
    same = dict.fromkeys((*IDENTITY, *RESULT), "1") | {"mend": "", "data_seconds": ""}
    for row in (new, same):
        append_rows(tmp_path / "a.csv", (*IDENTITY, *RESULT), [row], row)
    assert read_rows(tmp_path / "a.csv") == [old | {"data_seconds": "", "mend": "", "mean_v": ""}, new]
    adopt_runs(tmp_path / "b.csv", [same])
    assert read_rows(tmp_path / "b.csv") == [old | {"data_seconds": "", "mend": "", "mean_v": ""}]
    with pytest.raises(ValueError, match="has the columns"):
        append_rows(tmp_path / "a.csv", IDENTITY, [new], new | {"seed": "2"})
    assert len(read_rows(tmp_path / "a.csv")) == 2


def checkpoint_of(folder, method):
    """Returns the folder of a method's run if it has a checkpoint, otherwise a false value."""
    found = list(folder.glob(f"outputs/paper/results/{method}__*"))
    return found and CheckpointRotation(found[0] / "checkpoints" / method, keep_last=1).latest() and found[0]


@pytest.mark.slow
def test_a_run_that_dies_is_reported_with_its_reason_and_the_others_go_on(command, tmp_path):
    grid = command(*GRID, "methods=[h2o_plus,iql]", "updates=20", "sim_capacity=1e12", script="paper.py")
    done = subprocess.run(**grid, text=True, check=False)
    assert done.returncode != 0
    assert [row["method"] for row in read_rows(tmp_path / "results.csv")] == ["iql"]
    assert "these runs failed:\n  method=h2o_plus" in done.stdout
    assert "allocate memory" in done.stdout  # for the simulated buffer, which IQL does not fill
    assert done.stdout.count("run folder:") == 3  # IQL once, H2O+ twice, because it is tried again once


@pytest.mark.parametrize(
    ("override", "shown"),
    [
        ("data=/home/me/logs/a.txt", "data=logs/a.txt"),
        ("data=[/home/me/logs/a.txt,/home/me/logs/b.txt]", "data=[logs/a.txt,logs/b.txt]"),
        ("gap_fix='/home/me/outputs/report.json'", "gap_fix='outputs/report.json'"),
        ("data=halfcheetah/medium-v0", "data=halfcheetah/medium-v0"),
    ],
)
def test_results_name_no_folder_of_the_machine(compose, override, shown):
    cfg, _ = compose("method=iql", config="train")
    cfg.overrides = ["method=iql", override]
    assert shlex.split(repeating_command(cfg))[-1] == shown
    assert "/home" not in identity(cfg)["others"]
