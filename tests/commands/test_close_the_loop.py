"""The close-the-loop command: its report, its errors, and training in the mended simulator."""

import dataclasses
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton

from tests.composed import composed
from tests.full_disk import full_disk
from torchrl_h2o.commands.close_the_loop import (
    chosen_entries,
    expanded,
    make_simulation,
    minutes_left,
    print_files,
    print_result,
    run,
)
from torchrl_h2o.commands.recording import Recording, read_recording
from torchrl_h2o.data import LogColumns, write_ted
from torchrl_h2o.data.readers.ted import to_ted
from torchrl_h2o.effects import Gravity, JointDamping, JointForce, LoadFriction
from torchrl_h2o.envs import WheelLeggedEnv, mujoco_model
from torchrl_h2o.residuals import Report, Simulation
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect, OtherExplanation
from torchrl_h2o.residuals.report.errors import DimensionError, ErrorSummary
from torchrl_h2o.residuals.report.mended_model import LeftOut, MendedModel
from torchrl_h2o.residuals.report.words import effect_units, effect_words
from torchrl_h2o.training.environments import make_simulator, task_of
from torchrl_h2o.training.mending import find_missing_effects, prepare_mending

ROOT = Path(__file__).parents[2]
PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.0025"/>
  <worldbody>
    <body name="arm">
      <joint name="pivot" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.7"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>
"""
COLUMNS = """
dt: 0.01
separator: ","
header: true
columns:
  - {name: angle, role: observation, unit: rad}
  - {name: pivot_velocity, role: observation, unit: rad/s}
  - {name: torque, role: action, unit: N·m}
"""


@pytest.fixture
def robot(tmp_path):
    """An MJCF file, and a log of a robot with more joint damping than in the file."""
    (tmp_path / "robot.xml").write_text(PENDULUM)
    (tmp_path / "log.yaml").write_text(COLUMNS)
    reality = Simulation.from_mjcf(
        tmp_path / "robot.xml", ["pivot", "pivot_velocity"], 0.01, [JointDamping(0.1, joints="pivot")]
    )
    rng = np.random.default_rng(0)
    torque = np.repeat(rng.uniform(-2.0, 2.0, 80), 10)[:, None]
    states = reality.rollout(np.zeros((1, 2)), torque[None])[0]
    states = np.vstack([np.zeros((1, 2)), states[:-1]])
    np.savetxt(
        tmp_path / "log.csv",
        np.hstack([states, torque]),
        delimiter=",",
        header="angle,pivot_velocity,torque",
        comments="",
    )
    return tmp_path


def command(folder, *overrides, script="close_the_loop.py"):
    return subprocess.run(
        [sys.executable, str(ROOT / "recipes" / script), *overrides],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )


@pytest.fixture
def compose():
    def build(*overrides, config="close_the_loop"):
        folder = ROOT / ("torchrl_h2o" if config == "close_the_loop" else "recipes") / "config"
        return composed(config, *(full for override in overrides for full in expanded(override)), folder=folder)

    return build


def report(*effects):
    return Report(
        simulator="made up",
        data=DataSummary("log.csv, all 100 rows", 100, 30),
        error=ErrorSummary("one-step RMSE", "1", 1.0, 0.1, None, (DimensionError("pivot", "rad", 0.031, 0.004),)),
        found=tuple(FoundEffect(effect, True, {"scale": (0.49, 0.51)}, 0.1) for effect in effects),
    )


@pytest.mark.slow
def test_an_mjcf_file_and_a_log_are_enough(robot):
    chosen = ["simulator=robot.xml", "data=log.csv", "columns=log.yaml", "simulator.coordinates={angle: pivot}"]
    done = command(robot, *chosen, "catalogue=[JointDamping,Gravity]", "hydra.run.dir=out")
    assert done.returncode == 0, done.stdout
    written = json.loads((robot / "out" / "report.json").read_text())
    (found,) = written["effects"]
    assert found["parameters"]["damping"]["value"] == pytest.approx(0.1, rel=0.02)
    assert written["data"]["source"] == "log.csv, all 799 rows"
    assert (robot / "out" / "report.html").stat().st_size > 1000
    assert written["sentence"] in done.stdout
    assert "N·m·s/rad" in done.stdout
    assert "out/report.html" in done.stdout
    assert written["mended_model"] == {"file": "mended.xml", "failure": None, "left_out": [], "remedy": None}
    assert "out/mended.xml" in done.stdout
    mended = mujoco.MjModel.from_xml_path(str(robot / "out" / "mended.xml"))
    assert mended.dof_damping[0] == pytest.approx(0.12, rel=0.02)
    assert [window["rank"] for window in written["windows"]] == ["worst", "median", "best"]


def test_the_overrides_of_a_task_work_as_they_are_said(compose, tmp_path):
    data = GymRecording.write(tmp_path / "data")
    cfg = compose("simulator=HalfCheetah-v5", "simulator.gap=gravity", f"data={data}", "transitions=20")
    recording = read_recording(cfg)
    simulation = make_simulation(cfg, recording)
    assert simulation.model.opt.gravity[2] == pytest.approx(-19.62)
    assert simulation.name == "HalfCheetah-v5"
    assert len(recording.transitions) == 20
    assert recording.source == f"{data}, rows 0 to 19 of 40"
    halved = compose("simulator=HalfCheetah-v5", "simulator.gap=gravity", "simulator.gap_strength=0.5", f"data={data}")
    assert make_simulation(halved, recording).model.opt.gravity[2] == pytest.approx(-4.905)


class GymRecording:
    """Writes 40 random transitions with the dimensions of HalfCheetah's observations and actions."""

    @staticmethod
    def write(folder):
        values = np.random.default_rng(0).standard_normal((41, 17))
        never = np.zeros(40, bool)
        ted = to_ted(
            observation=values[:-1],
            action=np.zeros((40, 6)),
            next_observation=values[1:],
            terminated=never,
            truncated=never,
        )
        return write_ted(ted, folder)


@pytest.mark.parametrize(
    ("argument", "full"),
    [
        ("simulator=a/robot.xml", ["simulator=mjcf", "simulator.path=a/robot.xml"]),
        ("simulator=Hopper-v5", ["simulator=gymnasium", "simulator.task=Hopper-v5"]),
        ("simulator=wheel_legged", ["simulator=wheel_legged"]),
        ("data=halfcheetah/medium-replay-v0", ["data=halfcheetah/medium-replay-v0"]),
    ],
)
def test_short_forms_of_a_simulator(argument, full):
    assert expanded(argument) == full


def test_rows_are_taken_where_they_are_asked_for(compose, robot):
    chosen = ["simulator=robot.xml", f"data={robot / 'log.csv'}", f"columns={robot / 'log.yaml'}"]
    whole = read_recording(compose(*chosen)).transitions
    part = read_recording(compose(*chosen, "first_row=100", "transitions=50"))
    assert (part.transitions["observation"] == whole["observation"][100:150]).all()
    assert part.source.endswith("rows 100 to 149 of 799")


def test_effects_are_put_into_the_simulator(compose, robot):
    gravity = "simulator.effects=[{_target_: torchrl_h2o.effects.Gravity, scale: 3.0}]"
    wheels = compose("simulator=wheel_legged", gravity, "simulator.gap=gravity")
    simulation = make_simulation(wheels, Recording(None, "made up"))
    assert simulation.effects == (Gravity(3.0), Gravity(2.0))
    file = compose(f"simulator={robot / 'robot.xml'}", "data=log.csv", gravity, "simulator.coordinates={angle: pivot}")
    recording = Recording(None, "log.csv", LogColumns.load(robot / "log.yaml"))
    assert make_simulation(file, recording).effects == (Gravity(3.0),)


def test_the_catalogue_is_filtered_by_names_of_classes(compose, robot):
    simulation = Simulation.from_mjcf(robot / "robot.xml", ["pivot", "pivot_velocity"], 0.01)
    entries = chosen_entries(compose("catalogue=[Gravity,Joint*]"), simulation)
    classes = {type(entry.effect).__name__ for entry in entries}
    assert {"Gravity", "JointDamping"} <= classes
    assert all(name == "Gravity" or name.startswith("Joint") for name in classes)
    assert chosen_entries(compose(), simulation) is None


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["simulator=Hopper-v5"], "data=recorded requires the wheel-legged robot"),
        (["simulator=robot.xml", "data=log.csv"], "angle"),
        (["simulator=robot.xml", "data=log.csv", "simulator.coordinates={pitch: pivot}"], "the log observes angle"),
        (["simulator=nowhere.xml", "data=log.csv"], "nowhere.xml"),
        (["simulator=robot.xml", "data=log.csv", "first_row=5000"], "select none of the 799 rows"),
        (
            ["simulator=robot.xml", "data=log.csv", "catalogue=[Gravitas]", "simulator.coordinates={angle: pivot}"],
            "Gra",
        ),
    ],
)
def test_what_cannot_be_is_said_with_what_to_do(compose, robot, monkeypatch, overrides, said):
    monkeypatch.chdir(robot)
    cfg = compose(*overrides, "columns=log.yaml")
    with pytest.raises(ValueError, match=said):
        set_up(cfg)


def set_up(cfg):
    recording = read_recording(cfg)
    chosen_entries(cfg, make_simulation(cfg, recording))


def test_actions_in_another_order_than_the_actuators_are_refused(robot):
    columns = LogColumns.load(robot / "log.yaml")
    two = PENDULUM.replace("<motor", '<motor name="torque" joint="pivot"/><motor')
    model = Simulation.from_mjcf(robot / "robot.xml", ["pivot", "pivot_velocity"], 0.01).model
    Recording(None, "log.csv", columns).check_actuators(model)
    (robot / "two.xml").write_text(two)
    (robot / "two.yaml").write_text(
        COLUMNS.replace("  - {name: torque", "  - {name: motor, role: action, unit: N·m}\n  - {name: torque")
    )
    model = Simulation.from_mjcf(robot / "two.xml", ["pivot", "pivot_velocity"], 0.01).model
    with pytest.raises(ValueError, match=r"action: \[torque, motor\]"):
        Recording(None, "log.csv", LogColumns.load(robot / "two.yaml")).check_actuators(model)


def test_the_step_is_the_log_s_or_has_to_be_given(robot):
    columns = LogColumns.load(robot / "log.yaml")
    assert Recording({}, "log.csv", columns).control_step() == 0.01
    late = {"time": torch.tensor([0.0, 0.1, 0.3, 0.4, 0.5])[:, None]}
    assert Recording(late, "log.csv").control_step() == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"give simulator.control_step"):
        Recording({}, "ted").control_step()


def test_what_is_printed_is_short_and_has_units(capsys, tmp_path):
    print_result(report(Gravity(0.5)))
    print_files(report(Gravity(0.5)), tmp_path)
    printed = capsys.readouterr().out
    for part in ("Your simulator lacks: gravity × 0.5", "0.49 to 0.51", "rad", "0.031", "0.004", "report.html"):
        assert part in printed
    assert "mend=" in printed
    assert "next=" not in printed
    assert len(printed.splitlines()) < 20


def test_where_other_explanations_are_left_open_the_command_that_decides_is_printed(capsys, tmp_path):
    other = OtherExplanation((JointDamping(0.1, "pivot"),), 0.005)
    print_files(dataclasses.replace(report(Gravity(0.5)), others=(other,)), tmp_path)
    assert f"next={os.path.relpath(tmp_path)}/report.json" in capsys.readouterr().out


def test_values_that_no_fit_changed_are_not_printed(capsys):
    found = FoundEffect(LoadFriction(0.31, joints="knee"), True, {"share": (0.28, 0.34)}, 0.1)
    print_result(dataclasses.replace(report(Gravity(0.5)), found=(found,)))
    printed = capsys.readouterr().out
    assert "0.28 to 0.34" in printed
    assert "nan" not in printed


def test_units_and_effects_that_the_model_s_file_lacks_are_printed(capsys, tmp_path):
    names = {"joints": ["rail"], "joint_bodies": ["cart"], "joint_types": ["slide"]}
    push = JointForce(6.72, "rail")
    found = FoundEffect(push, True, {"torque": (6.5, 6.9)}, 0.1, effect_words(push, names), effect_units(push, names))
    mended = MendedModel("mended.xml", (LeftOut(push, "MJCF has no such force", effect_words(push, names)),))
    mended_report = dataclasses.replace(report(), found=(found,), mended_model=mended)
    print_result(mended_report)
    print_files(mended_report, tmp_path)
    printed = capsys.readouterr().out
    assert "force" + " " * 17 + "6.72  6.5 to 6.9 N\n" in printed
    assert "not in mended.xml: constant force of 6.72 N on joints rail" in printed


def test_a_report_mends_the_simulator_behind_its_own_gap(compose, tmp_path):
    path = report(Gravity(0.5)).save(tmp_path)
    broken = compose("gap=gravity", config="h2o_plus")
    mended = compose("gap=gravity", f"mend={path}", config="h2o_plus")
    prepare_mending(mended)
    mended.mended = find_missing_effects(mended, task_of(mended), None, tmp_path / "run")
    assert mujoco_model(make_simulator(broken)).opt.gravity[2] == pytest.approx(-19.62)
    assert mujoco_model(make_simulator(mended)).opt.gravity[2] == mujoco_model(WheelLeggedEnv()).opt.gravity[2]


def test_a_report_without_effects_and_a_file_that_is_none_are_refused(compose, tmp_path):
    path = report().save(tmp_path)
    with pytest.raises(ValueError, match="contains no effects to add to the simulator; leave mend out"):
        prepare_mending(compose(f"mend={path}", config="h2o_plus"))
    with pytest.raises(ValueError, match="cannot be read"):
        prepare_mending(compose(f"mend={tmp_path / 'none.json'}", config="h2o_plus"))


def test_the_files_are_written_within_the_minutes_and_the_audit_counts():
    assert minutes_left(None, 0.0) is None
    assert 0.9 < minutes_left(1.0, time.monotonic()) < 1.0
    assert minutes_left(1.0, time.monotonic() - 30.0) < 0.5
    with pytest.raises(ValueError, match=r"^minutes=1 is too short: reading and auditing the data took 2 minutes$"):
        minutes_left(1.0, time.monotonic() - 120.0)


def test_a_full_disk_does_not_lose_the_result(robot, monkeypatch, capsys):
    monkeypatch.chdir(robot)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    report(Gravity(0.5)).save(robot / "out")
    (robot / "out" / "mended.xml").write_text("with gravity × 0.5")
    before = {path: path.read_bytes() for path in (robot / "out").iterdir()}
    chosen = ["simulator=robot.xml", "data=log.csv", "columns=log.yaml", "simulator.coordinates={angle: pivot}"]
    chosen += ["audit=false", "hydra.run.dir=out"]
    monkeypatch.setattr(sys, "argv", ["close-the-loop", *chosen])

    def search(*args, so_far, **kwargs):
        so_far(report(Gravity(0.7)))
        return report(Gravity(0.8))

    monkeypatch.setattr("torchrl_h2o.commands.close_the_loop.close_the_loop", search)
    Plugins.instance()  # registered once, at their import
    state = Singleton.get_state()
    with full_disk(), pytest.raises(SystemExit, match="1"):
        run()
    Singleton.set_state(state)
    printed = capsys.readouterr()
    assert "Your simulator lacks: gravity × 0.8" in printed.out
    *_, line = printed.err.splitlines()
    assert line.startswith("OSError: ")
    assert "File too large" in line
    assert {path: path.read_bytes() for path in (robot / "out").iterdir()} == before


@pytest.mark.slow
def test_the_next_and_the_first_experiment_are_designed(robot):
    log = ["simulator=robot.xml", "data=log.csv", "columns=log.yaml", "simulator.coordinates={angle: pivot}"]
    report(JointDamping(0.1, "pivot")).save(robot / "found")
    done = command(robot, *log, "next=found/report.json", "minutes=0.02", "seconds=2", "hydra.run.dir=out")
    assert done.returncode == 0, done.stdout
    assert "The report leaves no other explanation open. The experiment narrows its intervals" in done.stdout
    (then,) = [line for line in done.stdout.splitlines() if line.startswith("then")]
    _, _, *again = shlex.split(then)
    assert again[-1] == "data=[NEW_LOG,log.csv]"
    assert {"simulator.path=robot.xml", "columns=log.yaml", "simulator.coordinates={angle: pivot}"} <= {*again}
    assert (robot / "out" / "commands.csv").read_text().startswith("time (s),motor")

    refused = command(robot, "plan=robot.xml")
    assert "actuators without a range of commands: motor; give each a ctrlrange in the model" in refused.stdout
    (robot / "limited.xml").write_text(PENDULUM.replace('joint="pivot"/>', 'joint="pivot" ctrlrange="-1 1"/>'))
    faster = "simulator.control_step=0.005"
    done = command(robot, "plan=limited.xml", faster, "minutes=0.02", "seconds=2", "hydra.run.dir=first")
    assert len((robot / "first" / "commands.csv").read_text().splitlines()) == 1 + 400
    assert "2 s of these commands would show, from known states and from this size on:" in done.stdout, done.stdout
    assert "look at    first/experiment.html" in done.stdout


@pytest.mark.slow
def test_training_runs_in_the_mended_simulator(tmp_path):
    report(Gravity(0.5)).save(tmp_path)
    small = ["updates=20", "updates_per_epoch=20", "steps_per_epoch=40", "eval_episodes=1", "final_episodes=1"]
    small += ["num_cells=[8,8]", "batch_size=[8,8]", "discriminator_batch_size=[8,8]", "render=false"]
    small += ["env.make.max_episode_steps=40", "env.recording.num_transitions=200", "threads=1", "n_steps=3"]
    done = command(
        tmp_path,
        *small,
        "gap=gravity",
        "mend=report.json",
        "warm_start=false",
        "hydra.run.dir=out",
        script="h2o_plus.py",
    )
    assert done.returncode == 0, done.stdout
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["mend"].endswith("report.json")
