"""The scripts that show the library's uses, and the tutorials: each runs and prints its result."""

import os
import re
import subprocess
import sys

import pytest

from tests.small_runs import ROOT

pytestmark = pytest.mark.slow

SCRIPTS = [
    ("swap_backbone.py", ["--backbone", "expectile", "--updates", "200"]),
    ("swap_backbone.py", ["--backbone", "sparse", "--updates", "200"]),
    ("swap_backbone.py", ["--backbone", "exponential", "--updates", "200"]),
    ("weighted_td3.py", ["--updates", "200"]),
    ("compose_losses.py", ["--updates", "200"]),
    ("pixels.py", ["100"]),
]


def run(script, folder, *arguments):
    done = subprocess.run(
        [sys.executable, str(ROOT / "recipes" / script), *arguments],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "warn" not in done.stderr.lower()
    return done.stdout


@pytest.mark.parametrize(("script", "arguments"), SCRIPTS)
def test_a_script_trains_with_a_small_budget_and_prints_returns(tmp_path, script, arguments):
    printed = run(script, tmp_path, *arguments)
    assert "return in reality" in printed
    assert re.search(r"data\s+\d+", printed)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("script", sorted({script for script, _ in SCRIPTS}))
def test_a_script_has_at_most_a_hundred_lines(script):
    assert len((ROOT / "recipes" / script).read_text().splitlines()) <= 100


def test_the_tutorial_on_your_own_env_learns_more_than_its_operator(tmp_path):
    printed = run("tutorials/h2o_plus_on_your_env.py", tmp_path)
    operator, policy = (float(value) for value in re.findall(r"return in reality: +(\d+) of 200", printed))
    assert policy > operator


def test_the_tutorial_on_backbones_trains_all_of_them(tmp_path):
    printed = run("tutorials/swap_a_backbone.py", tmp_path, "200")
    assert len(re.findall(r"return in reality +\d+ of 1000", printed)) == 3


def test_the_tutorial_on_another_algorithm_prints_weight_and_return(tmp_path):
    printed = run("tutorials/weight_another_algorithm.py", tmp_path, "200")
    weight = float(re.search(r"mean weight of simulated rows (\S+)", printed)[1])
    assert 0.0 < weight < 100.0
    assert "return in reality" in printed


def test_the_tutorial_on_simulators_finds_the_hidden_effect(tmp_path):
    printed = run("tutorials/what_does_my_simulator_lack.py", tmp_path, "out")
    assert "Your simulator lacks: damping of joints pivot + 0.1 N·m·s/rad" in printed
    assert (tmp_path / "out" / "report.html").stat().st_size > 1000
    assert (tmp_path / "out" / "log.csv").exists()


def test_the_tutorial_on_experiments_decides_between_a_payload_and_a_weak_motor(tmp_path):
    printed = run("tutorials/what_to_record_next.py", tmp_path, "out")
    first, both = (re.search(f"{logs}: (.*)", printed)[1] for logs in ("the first log", "both logs"))
    assert "shoulder_motor × 0.87" in first
    assert float(re.search(r"payload of (\S+) kg .* on bodies lower", both)[1]) == pytest.approx(0.15, rel=0.1)
    assert (tmp_path / "out" / "commands.csv").exists()


def test_the_main_job_needs_no_package_of_the_extra_comparison():
    blocked = "import sys; sys.modules.update(dict.fromkeys(['pandas', 'rliable', 'arch'])); import h2o_plus"
    done = subprocess.run([sys.executable, "-c", blocked], cwd=ROOT / "recipes", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
