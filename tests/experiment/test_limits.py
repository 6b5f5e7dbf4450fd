"""Limits of an experiment, and the state in which a machine rests."""

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum
from torchrl_h2o.effects import ActionDelay, ActionLag
from torchrl_h2o.experiment.limits import Envelope, Limits, state_at_rest
from torchrl_h2o.experiment.separation import Motion
from torchrl_h2o.residuals import Simulation, StateMap

SIMULATION = double_pendulum()
BALLS = """<mujoco><option gravity="0 0 0"/><worldbody>
<body name="a"><joint name="a" type="slide" axis="1 0 0" range="-2 2"/><geom size="0.1"/></body>
<body name="b" pos="0.5 0 0"><joint name="b" type="slide" axis="1 0 0"/><geom size="0.1"/></body>
</worldbody><actuator><motor joint="a" ctrlrange="-1 3"/><motor joint="b"/></actuator></mujoco>"""


SLIDE = """<mujoco><worldbody><body>{joint}<geom size="0.1"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>"""


def slide(actuator: str, frame_skip: int = 2, limits: str = "") -> Simulation:
    xml = SLIDE.format(joint=f'<joint name="z" type="slide" axis="0 0 1" {limits}/>', actuator=actuator)
    state_map = StateMap.of_coordinates(("z", "z_velocity"), ("m", "m/s"), range(2), 2)
    return Simulation(lambda: mujoco.MjSpec.from_string(xml), frame_skip, state_map)


def balls() -> Simulation:
    state_map = StateMap.of_coordinates(("a", "b", "a_velocity", "b_velocity"), ("m", "m", "m/s", "m/s"), range(4), 4)
    return Simulation(lambda: mujoco.MjSpec.from_string(BALLS), 2, state_map)


def test_limits_are_those_of_the_model_and_around_the_rest_and_of_the_log_without_any():
    limits = Limits.around(balls(), np.zeros(4), np.array([[0.0, -0.4], [0.1, 0.6]]), Envelope(within=5.0, speed=1.0))
    assert limits.command == pytest.approx(np.array([[-0.9, 2.9], [-0.4, 0.6]]))
    assert limits.position == pytest.approx(np.array([[-1.9, 1.9], [-5.0, 5.0]]))


def test_a_run_keeps_the_limits_or_not():
    limits = Limits.around(
        SIMULATION, np.zeros(4), np.array([[-1.0, -1.0], [1.0, 1.0]]), Envelope(within=0.5, speed=2.0)
    )
    runs = np.zeros((4, 3, 4))
    runs[1, 1, 0], runs[2, 2, 3], runs[3, 1, 1] = 0.6, -2.1, np.nan
    assert limits.kept(runs).tolist() == [True, False, False, False]


def test_parts_may_not_touch_that_are_apart_at_rest():
    simulation, commands = balls(), np.array([[-1.0, -1.0], [1.0, 1.0]])
    apart, together = (np.array([[0.0, 0.0, 0.0, 0.0], [x, 0.0, 0.0, 0.0]]) for x in (0.1, 0.35))
    strict, free = (
        Limits.around(simulation, np.zeros(4), commands, Envelope(within=1.0, speed=9.0, contact=contact))
        for contact in (False, True)
    )
    assert [strict.touches(simulation, each) for each in (apart, together, together[1:])] == [False, True, False]
    assert not free.touches(simulation, together)


def test_a_pendulum_without_damping_rests_where_it_hangs():
    rest = state_at_rest(SIMULATION, np.array([0.9, -0.4, 2.0, 1.0]), np.zeros(2))
    assert rest == pytest.approx(np.zeros(4), abs=1e-3)
    held = state_at_rest(SIMULATION, np.zeros(4), np.array([0.05, 0.0]))
    assert held[0] > 0.01


def test_a_machine_that_falls_for_ever_does_not_rest():
    with pytest.raises(ValueError, match="does not come to rest"):
        state_at_rest(slide('<motor joint="z"/>'), np.zeros(2), np.zeros(1))
    with pytest.raises(ValueError, match="the model has no actuator"):
        state_at_rest(slide(""), np.zeros(2), np.zeros(0))


SERVO = '<position joint="z" kp="400" kv="40" ctrlrange="-9 9"/>'


@pytest.mark.parametrize("late", [ActionDelay(0.05), ActionLag(0.05)])
@pytest.mark.parametrize("frame_skip", [1, 10])
def test_late_servos_rest_where_they_are_held_and_stay_there(late, frame_skip):
    machine = slide(SERVO, frame_skip).with_effects(late)
    rest = state_at_rest(machine, np.array([0.5, 0.0]), np.array([0.5]))
    assert rest[0] == pytest.approx(0.5 - 9.81 * 4.19 / 400.0, abs=0.01)  # a ball of 0.1 m, 4.19 kg
    motion = Motion.of(machine, rest, np.full((100, 1), 0.5))
    assert np.ptp(motion.states[:, 0]) < 0.01


def test_targets_of_servos_stay_in_the_limits_of_their_joints_and_a_gripper_may_rest_at_its_stop():
    machine, rest, command = slide(SERVO, limits='range="0 0.04"'), np.zeros(2), np.zeros((1, 1))
    around = Limits.around(machine, rest, command, Envelope(within=0.5, speed=1.0))
    assert around.position[0] == pytest.approx([0.0, 0.039])
    assert around.command[0] == pytest.approx([0.0, 0.039])
    assert around.kept(np.zeros((1, 5, 2))).all()


def test_a_free_base_has_no_limits_of_its_quaternion():
    xml = SLIDE.format(joint='<freejoint name="z"/>', actuator='<motor joint="z" gear="1 0 0 0 0 0"/>')
    names = ["z_x", "z_y", "z_z"]
    state_map = StateMap.of_coordinates(names, ["m"] * 3, range(3), 13)
    limits = Limits.around(
        Simulation(lambda: mujoco.MjSpec.from_string(xml), 2, state_map),
        np.zeros(13), np.zeros((1, 1)), Envelope(within=0.1, speed=1.0),
    )  # fmt: skip
    assert np.isinf(limits.position).all()
