"""The catalogue of a model: its entries, selections and trials."""

from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests.effects.models import ASSETS, as_bytes, spec
from torchrl_h2o import envs
from torchrl_h2o.effects import (
    ActionBacklash,
    ActionDeadBand,
    ActionGain,
    ActionLead,
    ActuatorTimeConstant,
    BodyMass,
    CatalogueEntry,
    ForceEffect,
    GearPlay,
    GeomFriction,
    GeomSize,
    Gravity,
    JointRange,
    JointStiffness,
    LoadFriction,
    ModelEffect,
    ObservationDelay,
    ObservationGain,
    Payload,
    ServoDamping,
    ServoDeadBand,
    ServoStiffness,
    StribeckFriction,
    TorqueSpeedLine,
    catalogue,
    compile_model,
    paper_gap,
)
from torchrl_h2o.effects.catalogue.choices import families

FILES = {
    "HalfCheetah": ASSETS / "half_cheetah.xml",
    "Walker2d": ASSETS / "walker2d.xml",
    "Hopper": ASSETS / "hopper.xml",
    "Ant": ASSETS / "ant.xml",
    "InvertedPendulum": ASSETS / "inverted_pendulum.xml",
    "wheel_legged": Path(envs.__file__).parent / "wheel_legged" / "wheel_legged.xml",
}


@cache
def entries_of(task: str, num_observations: int = 3) -> tuple[CatalogueEntry, ...]:
    model = mujoco.MjSpec.from_file(str(FILES[task]))
    return catalogue(model, num_observations=num_observations, dt=0.02)


def names_of(task: str) -> list[str]:
    return [entry.name for entry in entries_of(task)]


@pytest.mark.parametrize("task", FILES)
def test_there_are_at_least_25_kinds_of_effect_and_nothing_twice(task):
    entries = entries_of(task)
    assert len({type(entry.effect) for entry in entries}) >= 25
    assert len({entry.name for entry in entries}) == len({entry.effect for entry in entries}) == len(entries)


SCALED = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="carriage">
      <joint name="axis" type="slide" axis="1 0 0" damping="{mass}"/>
      <geom type="box" size="0.1 0.1 0.1" mass="{mass}"/>
      <body name="arm"><joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="{mass}"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="axis" gear="{mass}"/><motor joint="hinge" gear="{mass}"/></actuator>
</mujoco>
"""


def test_trials_of_a_crane_are_those_of_a_toy_with_all_forces_and_masses_a_million_times_as_large():
    toy, crane = (
        catalogue(mujoco.MjSpec.from_string(SCALED.format(mass=mass)), num_observations=4, dt=0.01)
        for mass in (0.1, 1e5)
    )
    assert [entry.name for entry in crane] == [entry.name for entry in toy]
    factors = {
        (entry.name, parameter): large[parameter] / small[parameter]
        for entry, other in zip(toy, crane, strict=True)
        for small, large in zip(entry.trials, other.trials, strict=True)
        for parameter in small
        if small[parameter]
    }
    wrong = {key: factor for key, factor in factors.items() if not np.isclose(factor, [1.0, 1e6], rtol=1e-6).any()}
    assert not wrong
    grown = {name.split("[")[0].split()[0] for (name, _), factor in factors.items() if factor > 2.0}
    assert grown >= {"JointDamping", "JointFrictionLoss", "Armature", "JointForce", "JointSpring", "LinearDrag"}


@pytest.mark.parametrize("task", ["Walker2d", "InvertedPendulum", "wheel_legged"])
def test_every_entry_is_neutral_and_every_trial_changes_what_it_acts_on(task):
    plain = mujoco.MjSpec.from_file(str(FILES[task]))
    unchanged = as_bytes(compile_model(plain))
    for entry in entries_of(task):
        assert entry.effect.is_neutral
        assert 2 <= len(entry.trials) <= 6
        for start in (entry.starts[0], entry.starts[-1]):
            assert not start.is_neutral
            model = compile_model(plain.copy(), [start])
            assert (as_bytes(model) != unchanged) == isinstance(start, ModelEffect)
            if isinstance(start, ForceEffect):
                data = mujoco.MjData(model)
                data.qvel[:] = 1.0
                mujoco.mj_forward(model, data)
                assert start.process(model, np.random.default_rng(0))(data).any()


@pytest.mark.parametrize("task", ["HalfCheetah", "Walker2d"])
@pytest.mark.parametrize("gap", ["gravity", "friction", "big_thigh", "broken_thigh", "long_torso", "soft_feet"])
def test_each_of_the_papers_gaps_in_the_model_can_be_named(task, gap):
    effect = paper_gap(gap)
    try:
        wanted = as_bytes(compile_model(spec(task), [effect]))
    except ValueError:
        pytest.skip("the paper has no such gap in this task")
    same = [entry for entry in entries_of(task) if type(entry.effect) is type(effect)]
    edited = [
        compile_model(spec(task), [type(effect)(**{**vars(entry.effect), "scale": effect.scale})]) for entry in same
    ]
    if gap in ("broken_thigh", "big_thigh", "gravity", "long_torso", "soft_feet", "friction"):
        assert wanted in [as_bytes(model) for model in edited]


def test_families_are_selected_together():
    names = names_of("HalfCheetah")
    for word in ("thigh", "shin", "foot"):
        assert {f"BodyMass *{word}*", f"GeomSize *{word}*", f"JointRange *{word}*"} <= set(names)
    assert {"ActionGain 0, 3", "ActionGain all", "ActionGain 5", "BodyMass torso", "Gravity"} <= set(names)
    assert {"JointDamping *left*", "JointDamping *thigh*"} <= set(names_of("Walker2d"))
    assert {"GeomSize *wheel*", "RollingResistance *wheel*"} <= set(names_of("wheel_legged"))


@pytest.mark.parametrize(
    ("task", "links"),
    [
        (
            "Walker2d",
            {
                *("thigh", "leg", "thigh_left", "leg_left", "*thigh*", "*leg*"),
                *("thigh_left, leg_left", "thigh, leg, thigh_left, leg_left"),
            },
        ),
        (
            "HalfCheetah",
            {"bthigh", "bshin", "fthigh", "fshin", "*thigh*", "*shin*", "bthigh, bshin, fthigh, fshin"},
        ),
        ("InvertedPendulum", {"cart"}),
    ],
)
def test_links_carry_joints_and_do_not_float(task, links):
    assert {name for name in names_of(task) if name.startswith("LinkLength")} == {f"LinkLength {one}" for one in links}


def test_what_lets_a_root_float_has_no_bearing_but_feels_the_wind():
    names = names_of("HalfCheetah")
    assert {"JointForce rootx", "JointForce rootz"} <= set(names)
    assert [name for name in names if "root" in name] == ["JointForce rootx", "JointForce rootz"]
    for entry in entries_of("Ant"):
        if type(entry.effect).__name__.startswith(("Joint", "Armature")):
            assert "root" not in entry.name


def test_an_undriven_hinge_on_the_world_is_a_bearing():
    pole = """<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" size=".02"/></body></worldbody></mujoco>"""
    names = [entry.name for entry in catalogue(mujoco.MjSpec.from_string(pole), num_observations=0, dt=0.01)]
    assert {"JointFrictionLoss hinge", "JointDamping hinge", "Armature hinge", "LinearDrag pole"} <= set(names)
    assert not [name for name in names if name.startswith(("Action", "Observation", "GeomFriction", "JointRange"))]


def test_what_can_change_nothing_is_left_out():
    kinds = {type(entry.effect) for entry in entries_of("wheel_legged")}
    assert JointRange not in kinds  # no joint has a range
    assert JointStiffness not in kinds  # no joint has a spring
    kinds = {type(entry.effect) for entry in entries_of("InvertedPendulum")}
    assert GeomFriction not in kinds  # nothing collides
    sizes = [entry.effect.geoms for entry in entries_of("wheel_legged") if isinstance(entry.effect, GeomSize)]
    assert not {"floor", "face", "left_hip"} & set(sizes)  # geoms of the world, and geoms without mass
    frictions = [entry for entry in entries_of("HalfCheetah") if entry.name == "GeomFriction bfoot"]
    # the floor has the same friction, so only an increase changes the contacts
    assert [trial["scale"] for trial in frictions[0].trials] == [1.25, 2.0]


def test_what_moves_in_a_plane_has_no_axis_across_it():
    planar = {entry.name: entry.fitted for entry in entries_of("HalfCheetah")}
    assert planar["BodyCentreOfMass torso"] == ("x", "z")
    assert planar["Payload torso"] == ("mass", "x", "z")
    assert planar["GravityTilt"] == ("pitch",)
    spatial = {entry.name: entry.fitted for entry in entries_of("Ant")}
    assert spatial["BodyCentreOfMass torso"] == ("x", "z", "y")
    assert spatial["GravityTilt"] == ("pitch", "roll")


def test_unnamed_elements_are_selected_through_their_body():
    arm = """<mujoco><worldbody><body name="arm"><joint axis="0 1 0"/><geom size=".1" mass="1"/>
      <body><joint axis="0 1 0"/><geom size=".1" mass="1" pos="0 0 1"/></body></body></worldbody></mujoco>"""
    names = [entry.name for entry in catalogue(mujoco.MjSpec.from_string(arm), num_observations=0, dt=0.01)]
    assert {"JointDamping arm/*", "JointDamping all", "BodyMass arm", "BodyMass all"} <= set(names)


def test_the_specification_is_left_as_it_is():
    model = spec("HalfCheetah")
    catalogue(model, num_observations=17, dt=0.05)
    assert as_bytes(compile_model(model)) == as_bytes(compile_model(spec("HalfCheetah")))


def test_sensors_are_left_out_where_nothing_is_observed():
    assert not [e for e in entries_of("Hopper", num_observations=0) if type(e.effect).__name__.startswith("Obs")]
    single = [e.effect for e in entries_of("Hopper", num_observations=1) if isinstance(e.effect, ObservationGain)]
    assert single == [ObservationGain()]


def test_servos_may_be_stiffer_or_weaker():
    arm = """<mujoco><worldbody><body><joint name="a"/><geom size=".1"/><body><joint name="b"/><geom size=".1"/></body>
      </body></worldbody><actuator>{}</actuator></mujoco>"""
    servos = '<position joint="a" kp="9"/><position joint="b" kp="9"/>'

    def offered(actuators, effect):
        entries = catalogue(mujoco.MjSpec.from_string(arm.format(actuators)), num_observations=0, dt=0.01)
        return [entry.effect.actuators for entry in entries if isinstance(entry.effect, effect)]

    def stiffness(actuators):
        return offered(actuators, ServoStiffness)

    assert stiffness(servos) == [(0,), (1,), None]
    assert stiffness(servos + '<motor joint="a"/>') == [(0,), (1,), None]
    assert stiffness('<position joint="a" kp="9"/>') == [None]
    assert stiffness('<motor joint="a"/>') == []
    assert offered(servos, ActuatorTimeConstant) == []
    assert offered(servos.replace('kp="9"', 'kp="9" timeconst="0.1"'), ActuatorTimeConstant) == [(0,), (1,), None]


def test_position_servos_have_gears_and_no_dead_band_of_their_commands():
    arm = """<mujoco><worldbody><body><joint name="a"/><geom size=".1" pos=".1 0 0"/><body><joint name="b"/>
      <geom size=".1"/></body></body></worldbody><actuator>{}</actuator></mujoco>"""
    servo, motor = '<position joint="a" kp="9"/>', '<motor joint="b"/>'

    def offered(actuators):
        found = {}
        for entry in catalogue(mujoco.MjSpec.from_string(arm.format(actuators)), num_observations=0, dt=0.01):
            effect = entry.effect
            found.setdefault(type(effect), []).append(getattr(effect, "actuators", None))
        return found

    of_servo = (ActionLead, ServoDeadBand, GearPlay, TorqueSpeedLine)
    alone, both, motors = offered(servo), offered(servo + motor), offered(motor)
    assert all(alone[kind] == [None] and both[kind] == [(0,)] and kind not in motors for kind in of_servo)
    assert ActionDeadBand not in alone
    assert both[ActionDeadBand] == both[ActionBacklash] == [(1,)]
    assert motors[ActionDeadBand] == [None]
    assert {LoadFriction, StribeckFriction} <= both.keys() - motors.keys()
    assert ServoDamping not in alone
    assert offered(servo.replace("/>", ' forcerange="-1 1"/>'))[ServoDamping] == [None]


def test_velocities_may_be_late_together():
    def delays(velocities):
        entries = catalogue(spec("Hopper"), num_observations=4, dt=0.01, velocities=velocities)
        return [entry.effect.entries for entry in entries if isinstance(entry.effect, ObservationDelay)]

    assert delays(()) == [None]
    assert delays((2, 3)) == [None, (2, 3)]
    assert delays((0, 1, 2, 3)) == [None]  # the same as all entries


@pytest.mark.parametrize(("dt", "num", "complaint"), [(0.0, 3, "not positive"), (0.01, -1, "is negative")])
def test_an_impossible_step_or_observation_is_refused(dt, num, complaint):
    with pytest.raises(ValueError, match=complaint):
        catalogue(spec("Hopper"), num_observations=num, dt=dt)


def test_an_entry_is_checked():
    with pytest.raises(ValueError, match="starts from the neutral effect"):
        CatalogueEntry(Gravity(2.0), ({"scale": 0.5},))
    with pytest.raises(ValueError, match="must name the same parameters"):
        CatalogueEntry(Gravity(), ())
    with pytest.raises(ValueError, match=r"BodyMass torso has the parameters \['scale'\]"):
        CatalogueEntry(BodyMass(bodies="torso"), ({"size": 0.5},))
    assert CatalogueEntry(ActionGain(actuators=(1, 3)), ({"scale": 0.5},)).name == "ActionGain 1, 3"


def test_a_family_shares_a_word():
    assert families(["wheel_1", "wheel_2", "arm"]) == {"wheel": (0, 1)}
    assert families(["left_wheel", "right_wheel"]) == {"wheel": (0, 1)}
    assert families(["lhip", "rhip", "lknee", "rknee"]) == {"hip": (0, 1), "knee": (2, 3)}
    assert families(["", "", "12"]) == {}


def test_a_limb_ends_before_its_frames_without_mass():
    """A model from a URDF has frames such as tool0 behind the last link."""
    xml = """
    <mujoco>
      <worldbody>
        <body name="base"><joint type="slide"/><geom size="0.1" mass="1"/>
          <body name="upper"><joint name="a" type="hinge"/><geom size="0.1" mass="1"/>
            <body name="lower" pos="0 0 -1"><joint name="b" type="hinge"/><geom size="0.1" mass="1"/>
              <body name="flange" pos="0 0 -1"><body name="tool0"/></body>
            </body>
          </body>
        </body>
      </worldbody>
    </mujoco>"""
    entries = catalogue(mujoco.MjSpec.from_string(xml), num_observations=3, dt=0.02)
    assert {entry.effect.bodies for entry in entries if isinstance(entry.effect, Payload)} == {"base", "lower"}


def test_an_earlier_version_of_mujoco_is_offered_where_all_inertias_follow_from_the_geoms():
    assert "EarlierCapsules" in names_of("Walker2d")
    assert "EarlierCapsules" not in names_of("wheel_legged")
