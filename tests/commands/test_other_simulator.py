"""A second simulator in the place of a robot: what it is commanded, and what is recorded."""

import numpy as np
import pytest
import torch

from tests.composed import COMMANDS, composed
from torchrl_h2o.commands.close_the_loop import make_simulation
from torchrl_h2o.commands.other_simulator import ACCELERATION, TURN, record_simulator
from torchrl_h2o.commands.recording import read_recording
from torchrl_h2o.residuals import Simulation
from torchrl_h2o.residuals.measured.residual import residuals
from torchrl_h2o.residuals.measured.transitions import Measured

ARM = """<mujoco><option timestep="0.005"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
  <body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5"/></body></body></worldbody>
  <actuator>{actuators}</actuator></mujoco>"""
MOTORS = """<motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow" ctrlrange="-0.2 0.4" gear="2"/>"""
SERVOS = """<position name="s1" joint="shoulder" kp="20" kv="1"/>
  <position name="s2" joint="elbow" kp="9" ctrlrange="-0.4 0.4"/>"""


@pytest.fixture
def models(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.xml").write_text(ARM.format(damping=0.05, actuators=MOTORS))
    (tmp_path / "b.xml").write_text(ARM.format(damping=0.2, actuators=MOTORS))
    (tmp_path / "servos.xml").write_text(ARM.format(damping=0.05, actuators=SERVOS))


def recorded(*overrides):
    mjcf = ["simulator=mjcf", "simulator.path=a.xml", "columns=null"]
    cfg = composed("close_the_loop", *mjcf, *overrides, folder=COMMANDS)
    recording = read_recording(cfg)
    return recording, make_simulation(cfg, recording)


def largest_residual(recording, simulation):
    measured = Measured.from_ted(recording.transitions, simulation)
    starts = np.flatnonzero(measured.usable)[:500]
    return np.abs(residuals(simulation, measured, starts, 1)).max()


def test_the_record_of_a_model_is_its_own_motion_and_not_that_of_another(models):
    assert largest_residual(*recorded("data=a.xml")) < 1e-5
    assert largest_residual(*recorded("data=b.xml")) > 1e-3


def test_motors_move_their_joints_within_their_ranges(models):
    td, layout = record_simulator("a.xml", "a.xml", 0.01, seed=0)
    assert (layout.dt, layout.action) == (0.01, ("command of m1", "command of m2"))
    assert layout.observation == ("shoulder", "elbow", "shoulder_velocity", "elbow_velocity")
    assert len(td) == 2000
    assert bool(td["next", "truncated"][-1])
    assert float(td["action"][:, 1].min()) >= -0.2 - 1e-6
    assert float(td["action"][:, 1].max()) <= 0.4 + 1e-6
    arm = Simulation.from_mjcf("a.xml", layout.observation, 0.01)
    assert float(td["action"][:, 0].abs().max()) == pytest.approx(ACCELERATION * arm.model.dof_M0[0], rel=1e-3)
    assert (td["observation"].std(0) > 0.05).all()


def test_servos_follow_targets_about_their_pose(models):
    td, _ = record_simulator("servos.xml", "servos.xml", None, seed=0)
    largest = td["action"].abs().amax(0)
    assert largest.tolist() == pytest.approx([TURN, TURN * 0.4], rel=1e-3)
    follows = torch.corrcoef(torch.stack([td["action"][:, 0], td["observation"][:, 0]]))[0, 1]
    assert float(follows) > 0.7


def test_the_phases_are_those_of_the_seed(models):
    first, again, other = (record_simulator("a.xml", "a.xml", 0.01, seed)[0]["action"] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_a_second_simulator_needs_a_first_one(models):
    cfg = composed("close_the_loop", "data=a.xml", folder=COMMANDS)
    with pytest.raises(ValueError, match=r"data=a\.xml is a second simulator: give simulator=robot\.xml"):
        read_recording(cfg)


def test_actuators_are_matched_by_name_or_else_by_joint(models, tmp_path):
    """Unnamed motors in another order would move another joint without a word."""
    swapped = """<motor joint="elbow" gear="2" ctrlrange="-0.2 0.4"/><motor joint="shoulder"/>"""
    (tmp_path / "c.xml").write_text(ARM.format(damping=0.05, actuators=swapped))
    assert largest_residual(*recorded("data=c.xml")) < 1e-5
    (tmp_path / "few.xml").write_text(ARM.format(damping=0.05, actuators='<motor joint="elbow"/>'))
    with pytest.raises(ValueError, match=r"the actuators of few\.xml, elbow, are not those of a\.xml, shoulder, elbow"):
        recorded("data=few.xml")
    with pytest.raises(ValueError, match=r"s1 is a position servo in servos\.xml and a motor in a\.xml"):
        recorded("data=servos.xml")


def test_commands_fit_the_gain_of_a_motor_and_the_speed_of_a_velocity_servo(models, tmp_path):
    sizes = []
    for actuators in (
        """<general joint="shoulder" gainprm="100"/>""",
        """<motor joint="shoulder"/>""",
        """<velocity joint="shoulder" kv="1"/>""",
    ):
        (tmp_path / "d.xml").write_text(ARM.format(damping=0.05, actuators=actuators))
        td, _ = record_simulator("d.xml", "d.xml", 0.01, seed=0)
        sizes.append(float(td["action"].abs().max()))
    assert sizes[1] == pytest.approx(100.0 * sizes[0], rel=1e-3)
    assert sizes[2] == pytest.approx(TURN, rel=1e-3)
