"""The benchmark of close_the_loop: correctness of its cases' ground truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import draw_case
from drawn_cases import HIDDEN, VISIBLE, plain, visibility
from hydra.utils import instantiate
from omegaconf import OmegaConf
from paper_cases import GAPS, what_mends
from robot_cases import EFFECTS
from running import FAMILIES
from systems import SYSTEMS, with_sensor_noise
from torchrl.envs import GymEnv, TransformedEnv
from undeclared_effects import CubicWind, LateForce, MovingSpring, PlaceFriction, TorqueRipple

import torchrl_h2o
from tests.recipes.benchmarks.made_up import report
from torchrl_h2o.effects import (
    ActionGain,
    BodyMass,
    Gravity,
)
from torchrl_h2o.envs import DynamicsGap, mujoco_model
from torchrl_h2o.residuals import Measured, residuals

SEED = 5


def one_step_error(case, *effects, rows=300):
    simulation = case.simulation()
    measured = Measured.from_ted(case.measure()[:rows], simulation)
    simulation = simulation.with_effects(*effects)
    return np.abs(residuals(simulation, measured, measured.windows(1))).max()


def short_case(case, transitions):
    return replace(case, transitions=transitions)


@pytest.mark.parametrize("number", range(len(GAPS)), ids=[" ".join(gap) for gap in GAPS])
def test_the_truth_of_every_paper_gap_gives_the_model_of_the_unmodified_task(number):
    task, gap = GAPS[number]
    case = draw_case(FAMILIES, "paper16", number, SEED)
    if gap == "joint_noise":
        assert not case.simulation().model.opt.gravity[2] > 0
        return
    mended = case.simulation().with_effects(*what_mends(gap)).model
    plain_model = mujoco_model(GymEnv(f"{task}-v5"))
    for field in ("body_mass", "body_inertia", "geom_size", "geom_friction", "jnt_range", "jnt_stiffness"):
        torch.testing.assert_close(getattr(mended, field), getattr(plain_model, field), rtol=1e-9, atol=1e-12)
    assert (mended.opt.gravity == plain_model.opt.gravity).all()


def test_the_truth_explains_the_data_of_a_paper_gap_and_the_gap_does_not():
    case = short_case(draw_case(FAMILIES, "paper16", GAPS.index(("HalfCheetah", "gravity")), SEED), 300)
    assert one_step_error(case, *case.truth) < 1e-3 < one_step_error(case)


def test_a_case_is_drawn_from_the_seed_and_its_number_alone():
    drawn = [draw_case(FAMILIES, "slow", 2, SEED) for _ in range(2)]
    other = draw_case(FAMILIES, "slow", 2, SEED + 1)
    assert drawn[0].truth == drawn[1].truth != other.truth
    assert (short_case(drawn[0], 20).measure() == short_case(drawn[1], 20).measure()).all()


@pytest.mark.parametrize(
    ("number", "seed"),
    [
        pytest.param(2, SEED, id="pendulum"),
        pytest.param(3, SEED, id="wheel_legged", marks=pytest.mark.slow),
        pytest.param(15, 0, id="one would be hidden", marks=pytest.mark.slow),
    ],
)
def test_every_one_of_several_effects_can_be_seen_and_explains_the_data(number, seed):
    case = draw_case(FAMILIES, "several", number, seed)
    simulation, measured = plain(case.system, 0)
    assert 2 <= len(case.truth) <= 3
    assert len({type(effect) for effect in case.truth}) == len(case.truth)
    for effect in case.truth:
        others = [other for other in case.truth if other is not effect]
        assert VISIBLE[0] / 2 < visibility(effect, simulation, measured)
        assert visibility(effect, simulation.with_effects(*others), measured) > HIDDEN
    case = short_case(case, 400)
    assert one_step_error(case, *case.truth) < 0.1 * one_step_error(case)


def test_what_cannot_be_seen_is_not_drawn():
    simulation, measured = plain("pendulum", 0)
    assert (
        visibility(Gravity(1.0001), simulation, measured) < VISIBLE[0] < visibility(Gravity(2.0), simulation, measured)
    )


@pytest.mark.parametrize("number", [0, *(pytest.param(number, marks=pytest.mark.slow) for number in range(1, 5))])
def test_an_undeclared_effect_is_no_entry_of_the_catalogue_and_can_be_seen(number):
    case = draw_case(FAMILIES, "undeclared", number, SEED)
    simulation = case.simulation()
    assert type(case.truth[0]) not in {type(entry.effect) for entry in simulation.catalogue()}
    assert simulation.effects == ()
    effect = replace(case.truth[0], start=0.0) if isinstance(case.truth[0], LateForce) else case.truth[0]
    assert VISIBLE[0] / 2 < visibility(effect, *plain(case.system, 0)) < 2 * VISIBLE[1]


@pytest.mark.slow
def test_an_undeclared_effect_sees_the_time_since_the_recording_began():
    case = short_case(draw_case(FAMILIES, "undeclared", 3, SEED), 1200)
    (late,) = case.truth
    assert isinstance(late, LateForce)
    data = case.measure()
    assert int(data["next", "done"].sum()) == 1
    simulation = case.simulation()
    measured = Measured.from_ted(data, simulation)
    starts = measured.windows(1)
    error = np.abs(residuals(simulation, measured, starts)).max((1, 2))
    begins = starts * simulation.control_step
    assert error[begins < late.start - 0.02].max() < 1e-4
    if (begins > late.start).any():
        assert error[begins > late.start].min() > 1e-4


@pytest.mark.parametrize(
    ("effect", "q", "v", "time", "torque"),
    [
        (TorqueRipple(2.0, waves=3.0), np.pi / 6, 0.0, 0.0, 2.0),
        (CubicWind(2.0, speed=3.0), 0.0, 6.0, 0.0, -16.0),
        (MovingSpring(2.0, swing=0.5, period=4.0), 0.0, 0.0, 1.0, 2.0),
        (MovingSpring(2.0, swing=0.5, period=4.0), 0.5, 0.0, 1.0, 0.0),
        (LateForce(2.0, start=3.0), 0.0, 0.0, 2.9, 0.0),
        (LateForce(2.0, start=3.0), 0.0, 0.0, 3.0, 2.0),
        (PlaceFriction(2.0, waves=1.0), np.pi / 2, 5.0, 0.0, -2.0),
        (PlaceFriction(2.0, waves=1.0), -np.pi / 2, 5.0, 0.0, 0.0),
    ],
)
def test_undeclared_torques_follow_their_formula(effect, q, v, time, torque):
    assert effect.torque_at(q, v, time) == pytest.approx(torque)


def test_mass_and_gain_of_the_decoy_cannot_be_told_apart():
    case = short_case(draw_case(FAMILIES, "decoy", 0, SEED), 300)
    (mass,) = case.truth
    assert isinstance(mass, BodyMass)
    assert one_step_error(case) > 1e-2
    for alike in (mass, ActionGain(1.0 / mass.scale, actuators=0)):
        assert one_step_error(case, alike) < 1e-4


def test_the_robot_has_the_effects_of_its_configuration():
    configured = OmegaConf.load(Path(torchrl_h2o.__file__).parent / "config" / "env" / "wheel_legged.yaml").env.reality
    assert {type(effect): values_of(effect) for effect in map(instantiate, configured)} == {
        type(effect): values_of(effect) for effect in EFFECTS
    }


def values_of(effect):
    return {name: parameter.value for name, parameter in effect.parameters.items()}


@pytest.mark.parametrize("number", [0, FAMILIES["robot"].size - 1])
def test_the_robot_s_last_case_is_a_control_without_effects(number):
    case = draw_case(FAMILIES, "robot", number, 0)
    assert case.in_reality == (() if number else EFFECTS)
    assert case.judge(report(), case)["ok"] == bool(number)
    assert case.judge(report(*EFFECTS), case)["ok"] == (not number)


def test_nothing_is_a_right_simulator_and_noisy_sensors():
    case = short_case(draw_case(FAMILIES, "nothing", 2, SEED), 300)
    assert case.simulation().effects == case.in_reality == case.truth == ()
    clean = SYSTEMS[case.system].record((), 300, case.seed)["observation"]
    noise = case.measure()["observation"] - clean
    torch.testing.assert_close(noise.std(0) / clean.std(0), torch.full((2,), 0.01), rtol=0.2, atol=0.0)


def test_sensor_noise_is_drawn_once_an_observation_and_leaves_the_data_alone():
    clean = SYSTEMS["Walker2d"].record((), 300, 0, episode=60)
    noisy = with_sensor_noise(clean, 0.01, 0, limit=10.0)
    goes_on = ~clean["next", "done"][:-1].flatten()
    assert (~goes_on).sum() == 4
    assert (noisy["next", "observation"][:-1] == noisy["observation"][1:])[goes_on].all()
    clipped = clean["observation"].abs() >= 10.0
    assert clipped.any()
    assert (noisy["observation"][clipped] == clean["observation"][clipped]).all()
    assert (noisy["observation"][~clipped] != clean["observation"][~clipped]).all()
    assert (clean == SYSTEMS["Walker2d"].record((), 300, 0, episode=60)).all()


@pytest.mark.parametrize(
    "system", ["pendulum", *(pytest.param(s, marks=pytest.mark.slow) for s in SYSTEMS if s != "pendulum")]
)
def test_a_recording_is_the_simulator_s_own_when_nothing_is_missing(system):
    simulation, measured = plain(system, 1)
    starts = measured.windows(1)
    change = (measured.following - measured.observation)[starts].std(0)
    assert measured.usable.mean() > 0.4
    # small, but not zero, because the unobserved slip of the wheels changes
    assert (np.median(np.abs(residuals(simulation, measured, starts)[:, 0]), axis=0) < 1e-2 * change).all()


def test_families_have_random_streams_of_their_own():
    streams = [family.stream for name, family in FAMILIES.items() if name != "servo_controls"]  # arms of "servos"
    assert len(set(streams)) == len(streams)


def test_undeclared_forces_reach_the_env():
    env = TransformedEnv(SYSTEMS["pendulum"].make(10), DynamicsGap(LateForce(2.0, start=0.0, joint="pivot")))
    plain_env = SYSTEMS["pendulum"].make(10)
    first = [e.rollout(1, lambda td: td.set("action", torch.zeros(1))) for e in seeded(env, plain_env)]
    assert (first[0]["observation"] == first[1]["observation"]).all()
    assert (first[0]["next", "observation"] != first[1]["next", "observation"]).any()


def seeded(*envs):
    for env in envs:
        env.set_seed(0)
    return envs
