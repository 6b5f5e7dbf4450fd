"""What servos do: derivative gain, torque-speed line, dead band of the error."""

import mujoco
import numpy as np
import pytest

from torchrl_h2o.effects import ActionLead, Pipeline, ServoDamping, ServoDeadBand, TorqueSpeedLine, compile_model
from torchrl_h2o.effects.states import States

XML = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="joint" axis="0 1 0" armature="0.01"/>
  <geom type="sphere" size=".02" pos="0 0 -.1" mass=".2"/></body></worldbody>
<actuator><position name="servo" joint="joint" kp="4" kv="0.1" gear="2" forcerange="-3 3"/></actuator></mujoco>
"""


def states(qpos: float, qvel: float, target: float) -> States:
    return States(np.array([[qpos]]), np.array([[qvel]]), np.zeros((1, 0)), np.array([[target]]), np.zeros(1))


def torque(effect, qpos: float, qvel: float, target: float) -> float:
    """Torque of the servo at the joint with the effect."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[0] = qpos, qvel, target
    mujoco.mj_forward(model, data)
    return data.qfrc_actuator[0] + effect.batched(model)(states(qpos, qvel, target))[0, 0]


@pytest.mark.parametrize(
    ("speed", "target", "expected"),
    [
        (0.0, 0.1, 0.8),  # below the line: 2 · 4 · 0.1
        (0.0, 1.0, 2.0),
        (0.0, -1.0, -2.0),
        (2.0, 1.0, 1.5),  # driving
        (-2.0, 1.0, 2.5),  # braking
        (10.0, 3.0, -0.5),  # beyond the no-load speed
    ],
)
def test_torque_stays_below_the_line(speed, target, expected):
    assert torque(TorqueSpeedLine(2.0, 8.0), 0.0, speed, target) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("target", "expected"), [(0.04, 0.0), (-0.05, 0.0), (0.15, 8 * 0.1), (-0.15, -8 * 0.1), (5.0, 6.0)]
)
def test_a_dead_band_reduces_the_error(target, expected):
    """The error is in the unit of the command; the torque is still limited."""
    assert torque(ServoDeadBand(0.05), 0.0, 0.0, target) == pytest.approx(expected)


def test_derivative_gain_on_the_error_is_lead_and_damping():
    """A servo with kd on the error, against one with kd on the velocity and a leading target."""
    dt, time = 0.01, 0.025
    targets = np.sin(3.0 * dt * np.arange(300))[:, None]
    led = Pipeline([ActionLead(time)]).executed_run(targets, dt)
    np.testing.assert_allclose(led[1:], targets[1:] + time * np.diff(targets, axis=0) / dt)
    np.testing.assert_array_equal(led[0], targets[0])


def test_damping_of_a_servo_counts_within_its_limit_alone():
    spec = mujoco.MjSpec.from_string(XML)
    model = compile_model(spec, [ServoDamping(0.3)])
    data = mujoco.MjData(model)
    assert model.actuator_biasprm[0, 2] == pytest.approx(-0.4)
    data.ctrl[0], data.qvel[0] = 10.0, 1.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(6.0)
    with pytest.raises(ValueError, match=r"servo 'servo' has a damping of 0.1, less than 0.2"):
        compile_model(mujoco.MjSpec.from_string(XML), [ServoDamping(-0.2)])
