"""A search finds what each joint lacks together, replaces what explains less, and takes no noise for an effect."""

import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import DOUBLE, double_pendulum, pendulum, recorded
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    ActionNoise,
    Armature,
    BodyCentreOfMass,
    BodyMass,
    Gravity,
    JointDamping,
    JointFrictionLoss,
    JointRange,
    JointSpring,
    LoadFriction,
    ResidualForce,
    StribeckFriction,
)
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.effects.model.joint import LOCKED
from torchrl_h2o.residuals import search
from torchrl_h2o.residuals.evidence import why_no_conclusion
from torchrl_h2o.residuals.explanation import Tried
from torchrl_h2o.residuals.ground import Found, Ground
from torchrl_h2o.residuals.progress import LoopBar, OutOfTimeError
from torchrl_h2o.residuals.search import disjoint, known_set, with_intervals, without_endless_rest

SIMULATION = double_pendulum()
KINDS = (JointFrictionLoss, JointDamping, Armature, ActionDelay, ActionGain, Gravity)
CATALOGUE = [entry for entry in SIMULATION.catalogue() if isinstance(entry.effect, KINDS)]
EACH_JOINT = (
    *(JointFrictionLoss(0.03, "shoulder"), JointFrictionLoss(0.01, "elbow")),
    *(JointDamping(0.02, "shoulder"), JointDamping(0.006, "elbow")),
    *(Armature(0.01, "shoulder"), Armature(0.002, "elbow")),
)


def found(measured, catalogue=CATALOGUE, **options):
    return search(SIMULATION, measured, catalogue, progress=LoopBar(disable=True), **options)


def values(effects):
    return {
        (type(effect).__name__, getattr(effect, "joints", None)): next(iter(effect.parameters.values())).value
        for effect in effects
    }


@pytest.mark.slow
def test_what_each_joint_lacks_is_found_with_a_delay_beside_it():
    truth = (*EACH_JOINT, ActionDelay(0.008))
    explanation = found(recorded(SIMULATION.with_effects(*truth), 2500, noise=0.001))
    assert values(explanation.effects) == pytest.approx(values(truth), rel=0.1)


def test_the_same_friction_in_all_joints_is_one_effect():
    (part,) = found(recorded(SIMULATION.with_effects(JointFrictionLoss(0.02)), 1200)).parts
    assert part.effect.joints == "*"
    assert part.effect.torque == pytest.approx(0.02, rel=0.02)


def test_noise_of_the_logged_torques_is_no_friction():
    """It moves the simulator and not the machine, so what makes the simulator deaf to it predicts far ahead better."""
    measured = recorded(SIMULATION, 2000, noise=1e-4)
    noise = 0.3 * measured.action.std(0) * np.random.default_rng(1).standard_normal(measured.action.shape)
    assert found(replace(measured, action=measured.action + noise)).effects == ()


def test_the_last_fit_has_the_expected_commands_if_the_time_is_up(monkeypatch):
    module, calls, grounds = sys.modules[search.__module__], [], []
    grow, with_intervals = module.grow, module.with_intervals

    def grow_once(*args):
        calls.append(args)
        if len(calls) > 1:
            raise OutOfTimeError("looking for effects")
        return grow(*args)

    monkeypatch.setattr(module, "grow", grow_once)
    monkeypatch.setattr(module, "with_intervals", lambda *args: grounds.append(args[0]) or with_intervals(*args))
    measured = recorded(SIMULATION.with_effects(JointFrictionLoss(0.03)), 2000, noise=1e-4)
    noise = 0.3 * measured.action.std(0) * np.random.default_rng(1).standard_normal(measured.action.shape)
    frictions = [entry for entry in CATALOGUE if isinstance(entry.effect, JointFrictionLoss)]
    noisy = replace(measured, action=measured.action + noise)
    assert found(noisy, frictions).ended_in == "looking for effects"
    assert grounds[0].logged is not None


@pytest.mark.parametrize("rows", [800, pytest.param(1600, marks=pytest.mark.slow)])
def test_a_wave_is_one_term_beside_the_gravity_that_two_waves_and_a_spring_imitate(rows):
    one_joint, wave = pendulum(), ResidualForce(("torque on elbow: 0.2 · sin(7 q)",))
    measured = recorded(one_joint.with_effects(Gravity(1.3), wave), rows, noise=0.002)
    catalogue = [entry for entry in one_joint.catalogue() if isinstance(entry.effect, Gravity | JointFrictionLoss)]
    effects = search(one_joint, measured, catalogue, progress=LoopBar(disable=True)).effects
    assert [type(effect) for effect in effects] == [Gravity, ResidualForce]
    assert effects[0].parameters["scale"].value == pytest.approx(1.3, rel=0.01)
    assert [term.coefficient for term in effects[1].parsed] == pytest.approx([0.2], rel=0.02)


def test_a_search_goes_on_from_a_known_force_term_by_term():
    gravity = entry_of(Gravity(1.1), CATALOGUE)
    force = ResidualForce(("torque on elbow: 0.1 · t", "torque on elbow: 0.2 · sin(7 q)"))
    known = known_set(CATALOGUE, [Gravity(1.1), force, BodyMass(2.0, "upper"), ActionNoise(0.1)])
    assert known.entries[0] is gravity
    assert [effect.describe() for effect in known.effects[1:]] == [
        ResidualForce((term,)).describe() for term in force.terms
    ]


@pytest.mark.slow
def test_a_force_outside_the_catalogue_stands_beside_its_effects():
    ripple = ResidualForce(("torque on shoulder: 0.1 · sin(6 q)",))
    explanation = found(recorded(SIMULATION.with_effects(Gravity(1.2), ripple), 2500))
    gravity, force = explanation.parts
    assert (gravity.declared, force.declared) == (True, False)
    assert gravity.effect.scale == pytest.approx(1.2, rel=0.02)
    assert force.effect.parameters["frequency_1"].value == pytest.approx(6.0, rel=0.02)


def test_a_delay_that_hardly_shows_beside_the_noise_is_found():
    explanation = found(recorded(SIMULATION.with_effects(ActionDelay(0.013, (0,))), 1200, noise=0.01))
    assert values(explanation.effects) == pytest.approx({("ActionDelay", None): 0.013}, rel=0.15)


def test_what_is_far_smaller_than_the_gap_is_not_explained_and_alone_it_is():
    gravity, damping = Gravity(1.5), JointDamping(2e-4, "shoulder")
    both, alone = (found(recorded(SIMULATION.with_effects(*one), 800)) for one in ((gravity, damping), (damping,)))
    assert [type(effect) for effect in both.effects] == [Gravity]
    assert values(alone.effects) == pytest.approx({("JointDamping", "shoulder"): 2e-4}, rel=0.01)


def test_one_effect_on_each_joint_stands_for_a_shared_one_and_a_further_one():
    effects = JointDamping(0.01, "*"), Gravity(1.1), JointDamping(0.02, "elbow")
    entries = [entry_of(one, SIMULATION.catalogue()) for one in effects]
    assert None not in entries
    sets = Found(tuple(one for one in entries if one), effects, np.zeros(0))
    alike = [[sets], [], [sets]]
    apart, others = disjoint(sets, alike, SIMULATION.catalogue(), SIMULATION)
    assert values(apart.effects) == pytest.approx(
        {("Gravity", None): 1.1, ("JointDamping", "shoulder"): 0.01, ("JointDamping", "elbow"): 0.03}
    )
    assert others == [[], [], []]
    assert disjoint(sets, [], SIMULATION.catalogue(), SIMULATION)[1] == ()  # where the time was up


def test_bodies_that_share_an_effect_beside_a_further_one_have_one_each():
    effects = BodyMass(2.0, "*"), BodyMass(0.5, "lower")
    entries = [entry_of(one, SIMULATION.catalogue()) for one in effects]
    assert None not in entries
    apart, _ = disjoint(Found(tuple(entries), effects, np.zeros(0)), [], SIMULATION.catalogue(), SIMULATION)
    assert {effect.bodies: effect.scale for effect in apart.effects} == {"upper": 2.0, "lower": 1.0}


@pytest.mark.parametrize("speed", [1e3, 0.5])
def test_friction_at_rest_that_no_motion_leaves_is_dry_friction(speed):
    arm = DOUBLE.replace("motor joint", 'position kp="2" joint')
    servos = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(arm))
    effects = JointFrictionLoss(0.01, "elbow"), StribeckFriction(0.02, speed, 0.1, joints="elbow")
    entries = [entry_of(effect, catalogue := servos.catalogue()) for effect in effects]
    ground = Ground.of(servos, recorded(servos.with_effects(*effects), 400, noise=0.001), effects)
    sets, alike = ground.found(entries, effects), [[ground.found((), ())], []]
    changed, others = without_endless_rest(ground, sets, alike, catalogue)
    if speed > 1.0:
        friction, load = changed.effects
        assert (type(friction), type(load)) == (JointFrictionLoss, LoadFriction)
        assert (friction.torque, load.share) == pytest.approx((0.03, 0.1), rel=0.05)
        assert others == alike
    else:
        assert (changed, others) == (sets, alike)
    assert without_endless_rest(ground, sets, alike, entries) == (sets, alike)  # without friction of the load


@pytest.mark.parametrize(
    ("idle", "there"),
    [
        (JointDamping(1e-3, "elbow"), JointDamping(0.03, "elbow")),
        (BodyCentreOfMass(1e-4, 1e-4, 1e-4, bodies="lower"), BodyCentreOfMass(z=0.05, bodies="lower")),
    ],
    ids=["one value", "several values"],
)
def test_an_effect_whose_interval_holds_its_neutral_value_is_left_out_of_the_last_fit(idle, there):
    effects = Gravity(1.3), idle
    entries = [entry_of(effect, SIMULATION.catalogue()) for effect in effects]
    for truth in (effects[:1], (effects[0], there)):
        ground = Ground.of(SIMULATION, recorded(SIMULATION.with_effects(*truth), 800, noise=0.01))
        found, fit, _ = with_intervals(ground, ground.found(entries, effects), [])
        assert [type(effect) for effect in found.effects] == [type(effect) for effect in truth]
        assert len(fit.in_another_log) == len(truth)


def together(parts):
    """Several logs, a run each, as one recording."""
    arrays = ("observation", "action", "following", "time", "usable", "split")
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in arrays}
    log = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return replace(parts[0], **whole, run=log, log=log)


def test_the_interval_of_several_logs_holds_the_values_of_each():
    """The damping of a machine that warms up differs between logs by far more than the noise within one says."""
    effect, ends = JointDamping(0.03, "elbow"), []
    for dampings in ((0.02, 0.03, 0.04), (0.03, 0.03, 0.03)):
        logs = [
            recorded(SIMULATION.with_effects(JointDamping(damping, "elbow")), 800, noise=0.01, seed=seed)
            for seed, damping in enumerate(dampings)
        ]
        ground = Ground.of(SIMULATION, together(logs))
        found, fit, _ = with_intervals(ground, ground.found([entry_of(effect, CATALOGUE)], [effect]), [])
        ends.append((found.effects[0].damping, fit.in_another_log[0]["damping"]))
    (value, half), (same, narrow) = ends
    assert same == pytest.approx(0.03, abs=3.0 * narrow)
    assert 0.02 < half < 0.1
    assert value - half < 0.02 < 0.04 < value + half
    assert narrow < 0.1 * half


def test_a_search_goes_on_from_known_effects():
    truth, first = (Gravity(1.3), ActionDelay(0.013)), []
    measured = recorded(SIMULATION.with_effects(*truth), 1200)
    explanation = found(measured, known=[Gravity(1.25)], so_far=first.append)
    assert explanation.steps[0].put_in == ("all actuators late by 0.013 s",)
    assert explanation.steps[0].dropped == ()
    assert explanation.steps[0].evidence > 10.0
    assert explanation.steps[0].gain > 0.0
    assert [type(effect) for effect in first[0].effects] == [Gravity, ActionDelay]
    assert values(explanation.effects) == pytest.approx(values(truth), rel=0.01)


def test_what_was_tried_and_not_put_in_is_listed_by_its_evidence():
    catalogue = [e for e in SIMULATION.catalogue() if isinstance(e.effect, Gravity | JointSpring | Armature)]
    real = SIMULATION.with_effects(Gravity(1.3), Armature(0.005, "elbow"))
    tried = found(recorded(real, 800, noise=0.01, seed=1), catalogue).tried
    assert len(tried) > 1
    evidence = [one.evidence for one in tried]
    assert evidence == sorted(evidence, reverse=True)
    assert not any(isinstance(one.effect, Gravity) for one in tried)


@pytest.mark.parametrize(("evidence", "p_value"), [(-1e4, 1.0), (0.0, 1.0), (2.3, 0.1), (1e4, 0.0)])
def test_the_p_value_of_what_was_tried_is_between_0_and_1(evidence, p_value):
    assert Tried(CATALOGUE[0], CATALOGUE[0].starts[0], evidence).p_value == pytest.approx(p_value, abs=0.01)


def test_effects_of_a_size_that_no_row_shows_are_listed_where_nothing_is_found():
    """Noise of a third of the motion hides dry friction of a usual size; without noise all effects would show."""
    still = recorded(SIMULATION, 1200, noise=0.3, seed=1)
    kinds = {type(effect) for effect in found(still).unseen}
    assert JointFrictionLoss in kinds
    assert not found(recorded(SIMULATION, 1200)).unseen


@pytest.mark.parametrize(("noise", "seed"), [(0.3, 0), (0.03, 2)])
def test_angles_whose_noise_is_radians_allow_no_conclusion(noise, seed):
    """These arms turn over, and the noise is a share of all turns: damping that is not there would be found."""
    reason = why_no_conclusion(SIMULATION, recorded(SIMULATION, 1200, noise=noise, seed=seed))
    assert "exceeds 1 rad, so the sensor does not tell where the joint is" in reason
    assert why_no_conclusion(SIMULATION, recorded(SIMULATION, 1200, noise=0.0, seed=seed)) is None


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_much_noise_of_angles_and_velocities_is_not_taken_for_damping(seed):
    """Of 0.3 rad and 30 % of the velocities' spread; the arm turns over in seeds 0 and 2."""
    exact = recorded(SIMULATION, 1200, seed=seed)
    rows = np.vstack([exact.observation, exact.following[-1:]])
    size = 0.3 * np.append([1.0, 1.0], rows.std(0)[2:])
    rows = rows + size * np.random.default_rng([seed, 7]).standard_normal(rows.shape)
    explanation = found(replace(exact, observation=rows[:-1], following=rows[1:]))
    assert explanation.effects == ()
    assert JointFrictionLoss in {type(effect) for effect in explanation.unseen}


def test_a_joint_that_is_locked_in_reality_is_no_joint_with_a_heavy_rotor():
    """Both keep the joint at its place, and the lock is the usual cause."""
    free = '<joint name="elbow" type="hinge" axis="0 1 0"/>'
    xml = DOUBLE.replace(free, free.replace("/>", ' limited="true" range="-1 1"/>'))
    simulation = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(xml))
    measured = recorded(simulation.with_effects(JointRange(LOCKED, "elbow")), 800, noise=0.005)
    catalogue = [entry for entry in simulation.catalogue() if isinstance(entry.effect, JointRange | Armature)]
    explanation = search(simulation, measured, catalogue, progress=LoopBar(disable=True))
    assert explanation.effects == (JointRange(LOCKED, "elbow"),)
