"""Rounds between a simulator and reality as a command: its files, its resumption, and other methods."""

import json
import subprocess

import pytest

from tests.composed import composed
from tests.small_runs import ROBOT, SMALL, run
from torchrl_h2o.options import SimToRealOptions, check_options
from torchrl_h2o.training.config_file import load_config

ROUNDS = [*SMALL, *ROBOT, "updates=20", "rounds=2", "seconds=0.2", "data_seconds=0.5", "hydra.run.dir=out"]


def rounds_of(folder):
    return json.loads((folder / "rounds.json").read_text())["rounds"]


@pytest.mark.slow
def test_each_round_adds_the_log_of_its_run_and_a_resumed_run_repeats_none(command, tmp_path):
    printed = run(command(*ROUNDS, "mend=posterior", "warm_start=true", script="sim_to_real.py"))
    out = tmp_path / "out"
    first, second = rounds_of(out)
    assert first["seconds"] == 0.5
    assert 0 < first["lasted"] <= 0.2
    assert second["seconds"] == pytest.approx(first["seconds"] + first["lasted"])
    assert first["low"] <= first["predicted"] <= first["high"]
    assert {path.name for path in out.iterdir()} >= {"rounds.json", "rounds.png", "round_1", "round_2"}
    assert {path.name for path in (out / "round_1").iterdir()} >= {"mended", "log", "config.yaml", "metrics.csv"}
    assert f"{first['measured']:,.0f}" in printed
    for part in ("rounds.json", "rounds.png"):
        (out / part).unlink()
    times = [path.stat().st_mtime_ns for path in out.glob("round_*/log/**/*")]
    run(command("resume=out", script="sim_to_real.py"))
    assert rounds_of(out) == [first, second]
    assert times
    assert times == [path.stat().st_mtime_ns for path in out.glob("round_*/log/**/*")]
    replayed = run(command("checkpoint=out/round_2", "episodes=1", "film=null", script="evaluate.py"))
    assert "H2O+ in reality" in replayed


@pytest.mark.slow
@pytest.mark.parametrize("chosen", [["method=sac", "randomise=0.2"], ["method=iql"]])
def test_other_methods_go_round_without_mending(command, tmp_path, chosen):
    run(command(*ROUNDS, *chosen, script="sim_to_real.py"))
    assert [one["found"] for one in rounds_of(tmp_path / "out")] == [[], []]
    mended = load_config(tmp_path / "out" / "round_2").mended
    worlds = [] if mended is None else [str(world) for world in mended.worlds]
    assert len(set(worlds)) == (10 if "randomise=0.2" in chosen else 0)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["seeds=[0,1]", "overlap=false"], "makes one run: leave out"),
        (["baselines=[sac]"], "makes one run: leave out"),
        (["randomise=0.2"], "is for a simulator that is not mended: add mend=false"),
        (["mend=false", "randomise=0.2", "env.batched=false"], "needs a batched simulator"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(overrides, said):
    with pytest.raises(ValueError, match=said):
        check_options(composed("sim_to_real", *overrides), SimToRealOptions)


@pytest.mark.slow
def test_a_wrong_option_is_one_line(command):
    done = subprocess.run(**command("rounds=0", script="sim_to_real.py"), text=True, check=False)
    assert done.returncode != 0
    assert "rounds=0: must be an integer from 1" in done.stdout
