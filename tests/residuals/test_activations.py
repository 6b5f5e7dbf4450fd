"""Actuators with dynamics: their activations follow from the commands, so a window continues the run that it is in."""

import mujoco
import numpy as np
import pytest

from torchrl_h2o.data import audit
from torchrl_h2o.effects import ActionSaturation, JointFrictionLoss, ResidualForce
from torchrl_h2o.residuals import Measured, Simulation, residuals
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.search import search
from torchrl_h2o.residuals.simulation.activations import activations_along

ARM = """
<mujoco>
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
SERVO = '<general name="servo" joint="hinge" ctrlrange="-1 1" dyntype="{kind}" dynprm="0.1" {act} {gain}/>'
STIFF = 'gainprm="20" biastype="affine" biasprm="0 -20 -1"'
ACTUATORS = {
    "filter": SERVO.format(kind="filter", act="", gain=STIFF),
    "filterexact": SERVO.format(kind="filterexact", act="", gain=STIFF),
    "bounded filter": SERVO.format(kind="filter", act='actlimited="true" actrange="-.5 .5"', gain=STIFF),
    "none": '<motor joint="hinge"/>',
}
FRAME_SKIP = 5


def commands(rows=300, seed=0):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.3, 1.3, (rows // 10, 1)), 10, axis=0)


def write(tmp_path, actuator):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(actuator=actuator, integrator="Euler"))
    return path


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("constant", ["0.1", "0.003"])
@pytest.mark.parametrize("name", ACTUATORS)
def test_activations_are_those_of_mujoco(name, constant, integrator):
    actuator = ACTUATORS[name].replace('dynprm="0.1"', f'dynprm="{constant}"')
    model = mujoco.MjModel.from_xml_string(ARM.format(actuator=actuator, integrator=integrator))
    data, action = mujoco.MjData(model), commands()
    along = activations_along(model, action, FRAME_SKIP)
    data.act[:] = along[0]
    for row, command in enumerate(action):
        np.testing.assert_allclose(along[row], data.act, atol=1e-12)
        data.ctrl[:] = command
        mujoco.mj_step(model, data, FRAME_SKIP)


def recording(simulation, seed=0):
    """Transitions of one run that begins with its actuator settled."""
    action = commands(600, seed)
    reached = simulation.rollout(np.zeros((1, 2)), action[None])[0]
    observed = np.vstack([np.zeros(2), reached])
    rows = np.arange(len(action))
    split = np.where(rows < 300, 0, np.where(rows < 420, 1, 2))
    return Measured(
        *(observed[:-1], action, observed[1:]),
        run=np.zeros(len(action), int),
        time=rows * simulation.control_step,
        usable=np.ones(len(action), bool),
        split=split,
        left_out={},
        source="arm",
    )


@pytest.mark.parametrize("name", ["filter", "filterexact"])
def test_windows_in_the_middle_of_a_run_continue_it(name, tmp_path):
    simulation = Simulation.from_mjcf(write(tmp_path, ACTUATORS[name]), ["hinge", "hinge_velocity"], 0.01)
    measured = recording(simulation)
    missed = residuals(simulation, measured, np.arange(0, 590, 7), 5)
    assert np.abs(missed).max() < 1e-9
    friction = simulation.with_effects(JointFrictionLoss(0.05))
    assert np.abs(residuals(friction, measured, np.arange(0, 590, 7), 5)).max() > 1e-3


@pytest.mark.parametrize(
    "actuator",
    [
        '<muscle name="biceps" joint="hinge" lengthrange="0 1"/>',
        '<intvelocity name="biceps" joint="hinge" kp="2" actrange="-1 1"/>',  # unknown when the log begins
        '<position name="biceps" joint="hinge" timeconst="0.1" delay="0.03" nsample="20"/>',
    ],
)
def test_an_activation_that_the_commands_do_not_tell_is_refused(actuator, tmp_path):
    with pytest.raises(ValueError, match=r"activation of biceps .*dyntype filter or filterexact"):
        Simulation.from_mjcf(write(tmp_path, actuator), ["hinge", "hinge_velocity"], 0.01)


def test_the_audit_finds_no_lag_of_the_actions_behind_the_filter_of_a_right_model(tmp_path):
    simulation = Simulation.from_mjcf(write(tmp_path, ACTUATORS["filter"]), ["hinge", "hinge_velocity"], 0.01)
    found = audit(recording(simulation), simulation).findings
    assert not [finding for finding in found if "later than" in finding.words or finding.check == "model"]


@pytest.mark.slow  # a search for a force
def test_a_control_times_a_position_may_stand_beside_a_saturation_that_is_never_reached(tmp_path):
    simulation = Simulation.from_mjcf(write(tmp_path, ACTUATORS["none"]), ["hinge", "hinge_velocity"], 0.01)
    truth = ResidualForce(("torque on hinge: 0.1 · a0 · q",))
    saturated = simulation.with_effects(ActionSaturation(9.0))
    (force,) = search(saturated, recording(simulation.with_effects(truth)), [], progress=LoopBar(disable=True)).effects
    assert "a0 · q" in force.describe() or "q · a0" in force.describe()
