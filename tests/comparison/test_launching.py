"""Launching a grid: no result is lost when it is killed or a run fails."""

import signal
import subprocess
from importlib.util import find_spec
from types import SimpleNamespace

import hydra
import pandas as pd
import pytest

from tests.small_runs import ROBOT, ROOT, SMALL, trained
from torchrl_h2o.comparison.launching import GridLauncher
from torchrl_h2o.comparison.results_file import (
    IDENTITY,
    RESULT,
    append_rows,
    read_rows,
)
from torchrl_h2o.data import write_ted
from torchrl_h2o.data.transition_checks import UnstableSimulatorError
from torchrl_h2o.training.checkpoint import checkpoint_file
from torchrl_h2o.training.config_file import load_config
from torchrl_h2o.training.divergence import DivergenceError
from torchrl_h2o.training.loop import train
from torchrl_h2o.training.methods import METHODS

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
    assert read_rows(tmp_path / "results.csv")["method"].tolist() == ["iql"]

    done = subprocess.run(**asked, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "2 runs, 1 of them done" in done.stdout
    assert done.stdout.count("run folder:") == 1
    assert read_rows(tmp_path / "results.csv")["method"].tolist() == ["iql", "cql"]

    cfg, real = compose("updates=200", "method=cql", config="train")
    train(METHODS["cql"], cfg, real, tmp_path / "unbroken")
    assert trained(second, "cql") == trained(tmp_path / "unbroken", "cql")

    one = load_config(second)
    assert one.seeds is None  # otherwise h2o_plus.py would resume it as a population
    moved = [*GRID[:-1], "results=elsewhere/results.csv", "methods=[cql]", "updates=200"]
    done = subprocess.run(**command(*moved, script="paper.py"), text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert read_rows(tmp_path / "elsewhere" / "results.csv")["method"].tolist() == ["cql"]


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
        rows = read_rows(tmp_path / f"{name}.csv").sort_values("method")
        recorded.append(rows[["method", "return_mean", "return_std"]].values.tolist())
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
            append_rows(grid.results, pd.DataFrame([who | dict.fromkeys(RESULT, "1")]))
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


def checkpoint_of(folder, method):
    """Returns the folder of a method's run if it has a checkpoint, otherwise a false value."""
    found = list(folder.glob(f"outputs/paper/results/{method}__*"))
    return found and checkpoint_file(found[0], method).exists() and found[0]


@pytest.mark.slow
def test_a_run_that_dies_is_reported_with_its_reason_and_the_others_go_on(command, tmp_path):
    grid = command(*GRID, "methods=[h2o_plus,iql]", "updates=20", "sim_capacity=1e12", script="paper.py")
    done = subprocess.run(**grid, text=True, check=False)
    assert done.returncode != 0
    assert read_rows(tmp_path / "results.csv")["method"].tolist() == ["iql"]
    assert "these runs failed:\n  method=h2o_plus" in done.stdout
    assert "allocate memory" in done.stdout  # for the simulated buffer, which IQL does not fill
    assert done.stdout.count("run folder:") == 3  # IQL once, H2O+ twice, because it is tried again once
