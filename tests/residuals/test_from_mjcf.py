"""Simulation.from_mjcf: names of coordinates, control steps, and errors that list the alternatives."""

from pathlib import Path

import numpy as np
import pytest

from torchrl_h2o.effects import BodyCentreOfMass, BodyInertia, Gravity, JointDamping, Payload
from torchrl_h2o.residuals import Simulation, StateMap

PENDULUM = Path(__file__).parents[2] / "recipes" / "models" / "simple_pendulum.xml"
COLUMNS = {"position": "hinge", "velocity": "hinge_velocity"}


def test_the_pendulum_swings_with_its_own_period():
    simulation = Simulation.from_mjcf(PENDULUM, ["hinge", "hinge_velocity"], 0.005)
    period = 2.0 * np.pi * np.sqrt(0.5 / 9.81)
    steps = round(period / 2 / 0.005)
    reached = simulation.rollout(np.array([[0.01, 0.0]]), np.zeros((1, steps, 1)))
    assert reached[0, -1, 0] == pytest.approx(-0.01, rel=1e-3)


def test_a_torque_turns_the_pendulum_by_its_inertia_alone():
    simulation = Simulation.from_mjcf(PENDULUM, ["hinge", "hinge_velocity"], 0.005)
    reached = simulation.rollout(np.zeros((1, 2)), np.ones((1, 1, 1)))
    assert reached[0, 0, 1] == pytest.approx(0.005 / (0.6755 * 0.25), rel=1e-3)


def test_both_rates_of_the_logs_fit_the_timestep():
    assert Simulation.from_mjcf(PENDULUM, COLUMNS, 0.00500035).frame_skip == 3
    assert Simulation.from_mjcf(PENDULUM, COLUMNS, 0.0033338).frame_skip == 2


def test_a_mapped_column_has_the_names_of_coordinate_and_column_and_its_unit():
    simulation = Simulation.from_mjcf(PENDULUM, {"velocity": "hinge_velocity", "position": "hinge"}, 0.005)
    assert simulation.state_map.names == ("hinge_velocity (velocity)", "hinge (position)")
    assert simulation.state_map.units == ("rad/s", "rad")
    np.testing.assert_array_equal(simulation.state_map.states(np.array([3.0, 0.5])), [0.5, 3.0])


def test_a_state_map_is_taken_as_it_is_and_effects_are_put_in():
    own = StateMap.of_coordinates(("q", "w"), ("rad", "rad/s"), (0, 1), num_states=2)
    simulation = Simulation.from_mjcf(PENDULUM, own, 0.005, [JointDamping(0.1)])
    assert simulation.state_map.names == ("q", "w")
    assert simulation.model.dof_damping[0] == pytest.approx(0.1)


def test_what_is_not_observed_stands_as_in_the_models_own_pose(tmp_path):
    path = tmp_path / "lift.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="lift" type="slide" ref="0.3"/><geom size="0.1"/>'
        '<body><joint name="turn"/><geom size="0.1"/></body></body></worldbody></mujoco>'
    )
    simulation = Simulation.from_mjcf(path, ["turn", "turn_velocity"], 0.01)
    assert simulation.state_map.states(np.zeros(2))[0] == pytest.approx(0.3)


def test_a_velocity_that_matters_and_that_nobody_observes_is_hidden():
    assert Simulation.from_mjcf(PENDULUM, ["hinge"], 0.005).state_map.hidden == (1,)
    assert Simulation.from_mjcf(PENDULUM, COLUMNS, 0.005).state_map.hidden == ()


@pytest.mark.parametrize("names", [["theta"], {"position": "theta"}])
def test_an_unknown_coordinate_is_named_beside_those_that_there_are(names):
    with pytest.raises(ValueError, match=r"no coordinate 'theta'.*hinge, hinge_velocity.*{theta: hinge}"):
        Simulation.from_mjcf(PENDULUM, names, 0.005)


def test_a_misspelt_coordinate_is_answered_with_the_right_one():
    with pytest.raises(ValueError, match="but 'hinge_velocity'"):
        Simulation.from_mjcf(PENDULUM, ["hinge", "hinge_velocit"], 0.005)


@pytest.mark.parametrize("names", [[], {}, "hinge"])
def test_no_coordinates_are_refused_with_those_that_there_are(names):
    with pytest.raises(ValueError, match="names no observed coordinates; give a list of some of hinge, hinge_velocity"):
        Simulation.from_mjcf(PENDULUM, names, 0.005)


def test_effects_that_are_none_are_refused():
    with pytest.raises(TypeError, match="got 'gravity'"):
        Simulation.from_mjcf(PENDULUM, ["hinge"], 0.005, "gravity")


BODY = "<mujoco><worldbody><body>{joint}<geom size='.1' mass='{mass}'/></body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BODY.format(joint="", mass=1), "has no joints"),
        (BODY.format(joint="<joint name='hinge'/>", mass="nan"), "mass='nan' of <geom> is not a number"),
        (
            BODY.format(joint="<joint name='hinge' damping='-NaN'/>", mass=1),
            "damping='-NaN' of <joint> is not a number",
        ),
    ],
    ids=["no joints", "mass", "damping"],
)
def test_a_model_that_cannot_move_or_holds_nan_is_refused(text, said, tmp_path):
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(ValueError, match=rf"robot\.xml.*{said}"):
        Simulation.from_mjcf(tmp_path / "robot.xml", ["hinge"], 0.005)


URDF = """<robot name="arm"><link name="base"><visual><geometry><mesh filename="package://arm/base.stl"/></geometry></visual>
  <collision><geometry><mesh filename="package://arm/base.stl"/></geometry></collision></link>
  <link name="upper">{upper}<visual><geometry><mesh filename="package://arm/upper.dae"/></geometry></visual></link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-9" upper="9" effort="3" velocity="5"/><dynamics damping="0.02" friction="0"/></joint>
  <joint name="flange" type="fixed"><parent link="upper"/><child link="tool"/></joint></robot>"""
INERTIAL = """<inertial><origin xyz="0 0 -0.2"/><mass value="1.5"/>
  <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.001"/></inertial>"""
SAME = """<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.02"/>
  <inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.001"/></body></worldbody>
  <actuator><motor joint="shoulder"/></actuator></mujoco>"""


def test_a_urdf_file_moves_without_its_meshes_by_a_motor_on_each_joint(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF.format(upper=INERTIAL))
    (tmp_path / "arm.xml").write_text(SAME)
    arms = [
        Simulation.from_mjcf(tmp_path / name, ["shoulder", "shoulder_velocity"], 0.01)
        for name in ("arm.urdf", "arm.xml")
    ]
    assert [arms[0].model.actuator(i).name for i in range(arms[0].model.nu)] == ["shoulder"]
    start, commands = np.array([[0.3, -0.5]]), np.sin(np.arange(20.0))[None, :, None]
    ends = [arm.rollout(start, commands) for arm in arms]
    assert ends[0] == pytest.approx(ends[1], abs=1e-9)


def test_effects_on_bodies_act_on_the_links_of_a_urdf_file(tmp_path):
    """The link that stands still is a body of the specification, and must be one of the model."""
    (tmp_path / "arm.urdf").write_text(URDF.format(upper=INERTIAL))
    arm = Simulation.from_mjcf(tmp_path / "arm.urdf", ["shoulder", "shoulder_velocity"], 0.01)
    for entry in arm.catalogue():
        if isinstance(entry.effect, BodyInertia | BodyCentreOfMass | Payload):
            changed = arm.with_effects(entry.starts[-1]).model
            assert changed.nbody == arm.model.nbody
            assert changed.body("upper").mass > 0.0
    heavier = arm.with_effects(BodyInertia(2.0, "upper")).model
    assert sorted(heavier.body("upper").inertia) == pytest.approx(sorted(2.0 * arm.model.body("upper").inertia))


def test_a_moving_link_of_a_urdf_file_without_a_mass_is_named(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF.format(upper=""))
    with pytest.raises(ValueError, match=r"give an <inertial> with a mass to the links upper$") as caught:
        Simulation.from_mjcf(tmp_path / "arm.urdf", ["shoulder"], 0.005)
    assert "\n" not in str(caught.value)


def test_one_coordinate_twice_is_refused():
    with pytest.raises(ValueError, match="hinge is named twice"):
        Simulation.from_mjcf(PENDULUM, ["hinge", "hinge"], 0.005)


def test_a_state_map_of_another_model_is_refused():
    with pytest.raises(ValueError, match=r"4 coordinates.*1 positions and 1 velocities"):
        Simulation.from_mjcf(PENDULUM, StateMap.of_coordinates(("q",), ("rad",), (0,), num_states=4), 0.005)


@pytest.mark.parametrize("step", [0.0, -0.005, float("inf"), float("nan"), "0.005", True, 1e9])
def test_a_control_step_that_is_no_time_between_two_rows_is_refused(step):
    with pytest.raises(ValueError, match=r"a control step of .*; give the time between two rows in s"):
        Simulation.from_mjcf(PENDULUM, COLUMNS, step)


@pytest.mark.parametrize(
    ("step", "frame_skip", "timestep"), [(0.004, 2, 0.002), (0.0005, 1, 0.0005), (0.01, 4, 0.0025)]
)
def test_the_timestep_is_reduced_to_the_next_one_that_fits_the_log(step, frame_skip, timestep, tmp_path):
    model = tmp_path / "pendulum.xml"
    model.write_text(PENDULUM.read_text().replace("0.0016666666666666668", "0.003"))
    simulation = Simulation.from_mjcf(model, COLUMNS, step)
    assert (simulation.frame_skip, simulation.model.opt.timestep) == (frame_skip, pytest.approx(timestep))
    assert simulation.with_effects(Gravity(2.0)).control_step == pytest.approx(step)


def test_a_file_that_is_not_there_or_no_model_is_named(tmp_path):
    with pytest.raises(ValueError, match="there is no file"):
        Simulation.from_mjcf(tmp_path / "robot.xml", COLUMNS, 0.005)
    (tmp_path / "robot.xml").write_text("<mujoco><worldbody><geom/></mujoco>")
    with pytest.raises(ValueError, match=r"cannot make a model of .*robot\.xml"):
        Simulation.from_mjcf(tmp_path / "robot.xml", COLUMNS, 0.005)
