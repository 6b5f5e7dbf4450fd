"""The benchmark of close_the_loop: correctness of its cases' ground truth and of its scores."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import Case, draw_case
from drawn_cases import HIDDEN, VISIBLE, plain, visibility
from families import FAMILIES, all_families, choose_families
from hydra.utils import instantiate
from omegaconf import OmegaConf
from paper_cases import GAPS, what_mends
from results_table import table
from robot_cases import EFFECTS
from running import Job, run_all
from scoring import (
    is_exact_set,
    is_listed_set,
    is_marked_undeclared,
    is_named_first,
    is_reported_as_group,
    parameter_error,
    reduction,
    says_nothing_is_missing,
)
from speed import CountingSimulation
from systems import SYSTEMS, with_sensor_noise
from torchrl.envs import GymEnv, TransformedEnv
from undeclared_effects import CubicWind, LateForce, MovingSpring, PlaceFriction, TorqueRipple

import torchrl_h2o
from torchrl_h2o.effects import (
    ActionGain,
    BodyMass,
    GeomFriction,
    GeomSize,
    Gravity,
    JointSpring,
    ObservationNoise,
    ResidualForce,
)
from torchrl_h2o.envs import DynamicsGap, mujoco_model
from torchrl_h2o.residuals import Measured, Simulation, residuals
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect, IndistinguishableGroup, OtherExplanation
from torchrl_h2o.residuals.report.document import Report
from torchrl_h2o.residuals.report.errors import ErrorSummary

SEED = 5


def report(*effects, before=1.0, after=0.0, floor=None, declared=True, groups=(), conclusion=None):
    return Report(
        simulator="made up",
        data=DataSummary("made up", 100, 30),
        error=ErrorSummary("one-step RMSE", "1", before, after, floor),
        found=tuple(FoundEffect(effect, declared, {}, after) for effect in effects),
        indistinguishable=tuple(IndistinguishableGroup(tuple(g), (after,) * len(g), "more motion") for g in groups),
        conclusion=conclusion,
    )


@pytest.fixture(scope="module")
def cheetah():
    return Simulation.from_env(SYSTEMS["HalfCheetah"].env())


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
    drawn = [draw_case(FAMILIES, "several", 2, SEED) for _ in range(2)]
    other = draw_case(FAMILIES, "several", 2, SEED + 1)
    assert drawn[0].truth == drawn[1].truth != other.truth
    assert (short_case(drawn[0], 20).measure() == short_case(drawn[1], 20).measure()).all()


@pytest.mark.parametrize(
    ("number", "seed"), [(2, SEED), (3, SEED), (15, 0)], ids=["pendulum", "wheel_legged", "one would be hidden"]
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


@pytest.mark.parametrize("number", range(5))
def test_an_undeclared_effect_is_no_entry_of_the_catalogue_and_can_be_seen(number):
    case = draw_case(FAMILIES, "undeclared", number, SEED)
    simulation = case.simulation()
    assert type(case.truth[0]) not in {type(entry.effect) for entry in simulation.catalogue()}
    assert simulation.effects == ()
    effect = replace(case.truth[0], start=0.0) if isinstance(case.truth[0], LateForce) else case.truth[0]
    assert VISIBLE[0] / 2 < visibility(effect, *plain(case.system, 0)) < 2 * VISIBLE[1]


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


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_recording_is_the_simulator_s_own_when_nothing_is_missing(system):
    simulation, measured = plain(system, 1)
    starts = measured.windows(1)
    change = (measured.following - measured.observation)[starts].std(0)
    assert measured.usable.mean() > 0.4
    # small, but not zero, because the unobserved slip of the wheels changes
    assert (np.median(np.abs(residuals(simulation, measured, starts)[:, 0]), axis=0) < 1e-2 * change).all()


def test_named_first_counts_parts_and_groups_but_no_other_class_or_place(cheetah):
    truth = (GeomSize(0.5, geoms="*thigh*"),)
    part, other_place = GeomSize(0.5, geoms="bthigh"), GeomSize(0.5, geoms="torso")
    assert is_named_first(report(part), truth, cheetah)
    assert not is_named_first(report(other_place, part), truth, cheetah)
    assert not is_named_first(report(Gravity(0.5)), truth, cheetah)
    assert not is_named_first(report(), truth, cheetah)
    group = (Gravity(0.5), part)
    assert is_named_first(report(Gravity(0.5), groups=[group]), truth, cheetah)
    assert not is_named_first(report(other_place, groups=[group]), truth, cheetah)


def test_an_exact_set_has_no_more_and_no_less_than_the_truth(cheetah):
    mass, gravity = BodyMass(2.0, bodies="torso"), Gravity(0.5)
    thighs = GeomSize(0.5, geoms="*thigh*")
    one, other = GeomSize(0.5, geoms="bthigh"), GeomSize(0.6, geoms="fthigh")
    assert is_exact_set(report(gravity, mass), (mass, gravity), cheetah)
    assert not is_exact_set(report(gravity), (mass, gravity), cheetah)
    assert not is_exact_set(report(gravity, mass, thighs), (mass, gravity), cheetah)
    assert is_exact_set(report(one, other), (thighs,), cheetah)
    assert not is_exact_set(report(one), (thighs,), cheetah)
    gain = ActionGain(0.5)
    assert is_exact_set(report(gain, gravity, groups=[(gain, mass)]), (mass, gravity), cheetah)


def test_the_truth_may_be_another_set_that_the_report_lists(cheetah):
    mass, gravity, gain = BodyMass(2.0, bodies="torso"), Gravity(0.5), ActionGain(0.5)
    listed = [OtherExplanation((gain,), 0.0, "more motion"), OtherExplanation((gravity, mass), 0.0, "more motion")]
    found = replace(report(gain), others=tuple(listed))
    assert is_listed_set(found, (mass, gravity), cheetah)
    assert not is_listed_set(found, (mass,), cheetah)
    assert not is_listed_set(report(mass, gravity), (mass, gravity), cheetah)


def test_patterns_and_names_of_the_same_elements_are_the_same(cheetah):
    names = tuple(geom.name for geom in cheetah.spec().geoms)
    assert is_exact_set(report(GeomFriction(3.0, geoms=names)), (GeomFriction(3.0),), cheetah)
    assert is_exact_set(report(ActionGain(0.5, actuators=tuple(range(6)))), (ActionGain(0.5),), cheetah)
    assert not is_exact_set(report(ActionGain(0.5, actuators=(0,))), (ActionGain(0.5),), cheetah)


def test_parameter_error_is_the_worst_of_all_truths(cheetah):
    springs = (JointSpring(120.0, joints="bfoot"), JointSpring(60.0, joints="ffoot"))
    found = (JointSpring(121.2, joints="bfoot"), JointSpring(63.0, joints="ffoot"))
    assert parameter_error(report(*found), springs, cheetah) == pytest.approx(0.05)
    assert parameter_error(report(found[0]), springs, cheetah) == np.inf
    mass = BodyMass(0.9, bodies="torso")
    assert parameter_error(report(Gravity(2.0), groups=[(Gravity(2.0), mass)]), (mass,), cheetah) == 0.0


def test_reduction_is_of_what_lies_above_the_floor():
    assert reduction(report(before=2.0, after=1.0)) == 0.5
    assert reduction(report(before=2.0, after=1.2), floor=1.0) == pytest.approx(0.8)
    assert np.isnan(reduction(report(before=1.0), floor=1.0))


def test_undeclared_nothing_and_group_are_read_off_the_report():
    assert is_marked_undeclared(report(Gravity(2.0), declared=False))
    assert not is_marked_undeclared(report(Gravity(2.0)))
    assert says_nothing_is_missing(report())
    assert not says_nothing_is_missing(report(ObservationNoise(0.1)))
    assert not says_nothing_is_missing(report(conclusion="too few rows"))
    pair = (BodyMass(2.0, bodies="arm"), ActionGain(0.5))
    assert is_reported_as_group(report(pair[0], groups=[pair]), pair)
    assert not is_reported_as_group(report(pair[0], groups=[(pair[0], Gravity(2.0))]), pair)


def perfect(simulation, data, **options):
    """The report that would be correct for the first decoy case."""
    return report(Gravity(2.0), groups=[(BodyMass(2.0, bodies="arm"), ActionGain(0.5))])


def failing(simulation, data, **options):
    raise RuntimeError("diverged")


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(Case, "measure", lambda self: SYSTEMS[self.system].record(self.in_reality, 20, 0))
    monkeypatch.setattr(Report, "save", lambda self, folder: folder)


@pytest.mark.usefixtures("short")
def test_a_case_that_fails_is_a_row_and_the_others_go_on(tmp_path):
    jobs = [Job("decoy", number, SEED, tmp_path) for number in range(2)]
    calls = iter([failing, perfect])
    rows = run_all(jobs, 1, lambda *args, **kw: next(calls)(*args, **kw), progress=False)
    assert [row["ok"] for row in rows] == [False, True]
    assert "diverged" in rows[0]["found"]
    saved = json.loads((tmp_path / "results.json").read_text())
    assert [row["number"] for row in saved] == [0, 1]
    lines = (tmp_path / "results.csv").read_text().splitlines()
    assert lines[0].startswith("family,number,name,system,truth,found,ok")
    assert len(lines) == 3
    printed = table(choose_families(["decoy"]), rows)
    assert "1 of 2" in printed
    assert "4 of 4" in printed


def test_slow_effects_pass_by_their_friction_or_by_a_torque_in_time():
    viscous, drift = (draw_case(FAMILIES, "slow", number, SEED) for number in (0, 1))
    assert viscous.judge(report(*viscous.truth), viscous)["ok"]
    assert not viscous.judge(report(JointSpring(0.1, joints="pivot")), viscous)["ok"]
    grows = ResidualForce(("torque on pivot: 0.01 · t",))
    pulls = ResidualForce(("torque on pivot: 0.01 · sin(7 q)",))
    assert drift.judge(report(grows), drift)["ok"]
    assert not drift.judge(report(pulls), drift)["ok"]
    assert not drift.judge(report(grows, *viscous.truth), drift)["ok"]


def test_a_family_draws_the_same_cases_beside_others():
    alone = draw_case(choose_families(["slow"]), "slow", 2, SEED)
    assert draw_case(choose_families(["nothing", "slow"]), "slow", 2, SEED).truth == alone.truth
    streams = [family.stream for family in FAMILIES.values()]
    assert len(set(streams)) == len(streams)


@pytest.mark.usefixtures("short")
def test_the_code_under_test_is_shown_neither_the_truth_nor_the_case(tmp_path):
    seen = []

    def spy(*args, **options):
        seen.append((args, options))
        return report()

    run_all([Job("paper16_noise", 0, SEED, tmp_path)], 1, spy, progress=False)
    ((simulation, data), options) = seen[0]
    assert isinstance(simulation, Simulation)
    assert set(data.keys()) == {"observation", "action", "done", "terminated", "truncated", "next"}
    assert options.keys() == {"source", "held_out", "seed", "progress"}
    assert "gravity" not in options["source"]


def test_steps_are_counted_in_all_that_is_made_of_a_simulation():
    simulation, measured = plain("pendulum", 0)
    counting = CountingSimulation.of(simulation)
    mended = counting.with_effects(Gravity(0.5))
    starts = np.arange(7)
    expected = residuals(simulation.with_effects(Gravity(0.5)), measured, starts, 3)
    before = counting.count.steps
    assert (residuals(mended, measured, starts, 3) == expected).all()
    assert counting.count.steps - before == 21
    assert counting.count.seconds > 0.0


def test_steps_are_counted_where_coordinates_are_not_observed():
    """Earlier, each case of the robot whose log lacks the speed of its wheels failed."""
    simulation, measured = plain("wheel_legged", 0)
    counting = CountingSimulation.of(simulation)
    starts = np.arange(7)
    assert (residuals(counting, measured, starts, 3) == residuals(simulation, measured, starts, 3)).all()


def test_families_are_chosen_by_name_and_logs_by_their_folder(tmp_path):
    assert list(choose_families(["nothing", "paper16"])) == ["paper16", "nothing"]
    assert list(choose_families(["nothing"], tmp_path)) == ["nothing", "log_wheel_legged", "log_pendulum"]
    assert list(choose_families(["log_pendulum"], tmp_path)) == ["log_pendulum"]
    with pytest.raises(ValueError, match="cases=paper: choose from paper16"):
        choose_families(["paper"])
    with pytest.raises(FileNotFoundError, match="no such folder"):
        choose_families([], tmp_path / "nowhere")
    assert set(all_families(tmp_path)) - set(FAMILIES) == {"log_wheel_legged", "log_pendulum"}


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
