"""Before the first log: which effects commands would show, from which size, and which look alike."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum
from torchrl_h2o.experiment import plan_experiment
from torchrl_h2o.experiment.design import Setting
from torchrl_h2o.experiment.excitation import candidate
from torchrl_h2o.experiment.limits import Envelope, Limits
from torchrl_h2o.experiment.separation import Explained, Yardstick
from torchrl_h2o.experiment.shown import further_effects, shown_effects, smallest_sizes
from torchrl_h2o.likelihood import ENOUGH
from torchrl_h2o.residuals import Simulation

SIMULATION = double_pendulum()
FIRST = Explained.nothing(SIMULATION)
KINDS = ("JointDamping", "JointFrictionLoss", "JointForce", "ActionBias", "ActionSaturation")


@pytest.fixture(scope="module")
def setting():
    limits = Limits.around(SIMULATION, np.zeros(4), np.zeros((1, 2)), Envelope(within=1.0, speed=8.0))
    unknown = [one for one in further_effects(FIRST) if type(one.effect).__name__ in KINDS]
    yard = Yardstick.of_encoders(SIMULATION, 1e-3)
    return Setting([FIRST], yard, limits, np.zeros(4), np.zeros(2), 300, 3.0, np.zeros(4), unknown=unknown)


@pytest.fixture(scope="module")
def knots(setting):
    return setting.largest(candidate("multisine", setting.seconds, 2, setting.band, np.random.default_rng(0)))


def named(setting, name):
    return next(one for one in setting.unknown if one.entry.name == name)


@pytest.mark.parametrize(
    "name", ["JointDamping elbow", "JointFrictionLoss shoulder", "JointForce elbow", "ActionBias 0"]
)
def test_an_effect_of_the_smallest_size_that_shows_shows_just_enough(setting, knots, name):
    alone = replace(setting, unknown=[named(setting, name)])
    (size,) = smallest_sizes(alone, knots, alone.overlaps(knots).diagonal(), np.array([ENOUGH]))
    assert 0.0 < size < 0.5
    smaller = replace(setting, unknown=[alone.unknown[0].resized(size)])
    assert smaller.overlaps(knots)[0, 0] == pytest.approx(ENOUGH, rel=0.1)


def test_noisier_encoders_show_only_larger_effects(setting, knots):
    blind = replace(setting, yard=Yardstick.of_encoders(SIMULATION, 1e-1))
    assert sum(one.is_shown for one in shown_effects(blind, knots)) < sum(
        one.is_shown for one in shown_effects(setting, knots)
    )


def test_a_saturation_that_no_command_reaches_does_not_show(setting, knots):
    shown = shown_effects(setting, 0.1 * knots)
    assert not any(one.is_shown for one in shown if one.words.startswith("saturation"))
    assert shown[0].is_shown


def test_a_constant_torque_of_a_joint_looks_like_a_bias_of_its_motor(setting, knots):
    pair = [named(setting, "JointForce elbow"), named(setting, "ActionBias 1"), named(setting, "JointDamping shoulder")]
    alike = {one.words.split(" of ")[0]: one.alike for one in shown_effects(replace(setting, unknown=pair), knots)}
    assert alike["constant torque"].startswith("bias")
    assert alike["bias"].startswith("constant torque")
    assert alike["damping"] is None


def test_a_plan_says_what_it_would_show_and_writes_it(tmp_path):
    plan = plan_experiment(SIMULATION, Envelope(seconds=2.0, within=1.0, speed=8.0), minutes=0.05, progress=False)
    plan.save(tmp_path)
    first, *others = plan.words().splitlines()
    assert first == "2 s of these commands would show, from known states and from this size on:"
    assert any("dry friction of" in line for line in others)
    page = (tmp_path / "experiment.html").read_text()
    assert "What it would not show" in page
    assert "The explanations" not in page
    assert 'src="preview.gif"' in page
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"commands.csv", "experiment.html", "experiment.json", "preview.gif"}


def test_without_a_renderer_all_but_the_film_is_written(tmp_path, monkeypatch, capsys):
    def fails(*args):
        raise RuntimeError("no OpenGL")

    monkeypatch.setattr("torchrl_h2o.experiment.files.film_motion", fails)
    plan_experiment(SIMULATION, Envelope(seconds=2.0, speed=8.0), minutes=0.01, progress=False).save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"commands.csv", "experiment.html", "experiment.json"}
    assert "no preview.gif: no OpenGL" in capsys.readouterr().out


def test_a_model_without_ranges_of_commands_is_refused(tmp_path):
    (tmp_path / "robot.xml").write_text(
        '<mujoco><worldbody><body><joint name="hip" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/></body></worldbody>'
        '<actuator><motor name="drive" joint="hip"/></actuator></mujoco>'
    )
    robot = Simulation.from_mjcf(tmp_path / "robot.xml", ["hip", "hip_velocity"], 0.01)
    with pytest.raises(ValueError, match="without a range of commands: drive; give each a ctrlrange"):
        plan_experiment(robot, progress=False)
