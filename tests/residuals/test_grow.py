"""How a search chooses: what a candidate is estimated to gain, which sets are tried, and which of them is better."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from tests.residuals.pendulum import DOUBLE, double_pendulum, pendulum, recorded
from torchrl_h2o.effects import (
    ActionBias,
    ActionDelay,
    ActionGain,
    Armature,
    BodyMass,
    Gravity,
    JointDamping,
    JointForce,
    JointFrictionLoss,
    Payload,
    ResidualForce,
    StribeckFriction,
)
from torchrl_h2o.effects.catalogue.entry import entry_of
from torchrl_h2o.likelihood import Difference
from torchrl_h2o.residuals.gains import Gains
from torchrl_h2o.residuals.ground import Found, Ground, surprise_of
from torchrl_h2o.residuals.grow import (
    Candidates,
    choices,
    gains_beside,
    grow,
    is_preferred,
    most_usual,
    on_best_elements,
    with_one_more,
)
from torchrl_h2o.residuals.sweep import Direction, sweep
from torchrl_h2o.residuals.whitened import flat

SIMULATION = double_pendulum()
KINDS = (JointFrictionLoss, JointDamping, Armature, ActionDelay, ActionGain, Gravity)
CATALOGUE = [entry for entry in SIMULATION.catalogue() if isinstance(entry.effect, KINDS)]
EACH_JOINT = (
    *(JointFrictionLoss(0.03, "shoulder"), JointFrictionLoss(0.01, "elbow")),
    *(JointDamping(0.02, "shoulder"), JointDamping(0.006, "elbow")),
    *(Armature(0.01, "shoulder"), Armature(0.002, "elbow")),
)


def test_with_noisy_commands_an_effect_must_predict_the_next_row_with_the_expected_and_the_logged_ones():
    ground = Ground.of(SIMULATION, recorded(SIMULATION, 800, noise=1e-4))
    blocks = np.arange(ground.num_fit + len(ground.base.selection.blocks)) % 7
    row = blocks[ground.num_fit :]
    friction, worse, better = entry_of(JointFrictionLoss(0.1), CATALOGUE), row - 1.0, 5.0 + 1.1 * row
    less = Found((), (), 0.01 * blocks, (row, row), is_noise=True)
    more = Found((friction,), (JointFrictionLoss(0.1),), 5.0 + 0.1 * blocks, (better, better))
    assert ground.adds(more, less)
    assert not ground.adds(replace(more, one_step=(better, worse)), less)
    assert not ground.adds(replace(more, one_step=(worse, better)), less)
    assert ground.adds(replace(more, one_step=(worse, worse)), replace(less, is_noise=False))


def test_rows_for_selection_must_agree_with_the_evidence_of_all_rows_but_need_not_suffice_alone():
    ground = Ground.of(SIMULATION, recorded(SIMULATION, 800, noise=1e-4))
    less = ground.found((), ())
    friction = JointFrictionLoss(0.1, "elbow")
    scatter = 2.0 * np.random.default_rng(0).standard_normal(len(less.scores))

    def adds(in_fit, in_selection):
        gain = scatter + np.where(np.arange(len(scatter)) < ground.num_fit, in_fit, in_selection)
        more = replace(less, entries=(entry_of(friction, CATALOGUE),), effects=(friction,), scores=less.scores + gain)
        return ground.adds(more, replace(less, is_noise=False))

    assert adds(2.0, 1.0)
    assert not adds(2.0, -1.0)
    assert not adds(0.2, 0.2)


def test_a_far_factor_is_simulated_for_itself():
    entries = [one for one in SIMULATION.catalogue() if one.name in ("LinkLength upper", "BodyMass upper")]
    directions = sweep(Ground.of(SIMULATION, recorded(SIMULATION, 400)).rough(()), entries)
    trials = {(one.entry.name, one.trial["scale"]): one.shares for one in directions}
    assert trials.keys() == {("BodyMass upper", 0.8), *(("LinkLength upper", scale) for scale in (0.05, 0.4, 0.8))}
    assert min(trials["LinkLength upper", 0.8]) < 0.0 == min(trials["LinkLength upper", 0.05])


def test_what_has_no_neutral_value_stays_as_it_was_simulated():
    """Half of a friction at rest fades at the same speed."""
    arm = DOUBLE.replace("motor joint", 'position kp="2" joint')
    servos = replace(SIMULATION, spec=lambda: mujoco.MjSpec.from_string(arm))
    entries = [entry for entry in servos.catalogue() if isinstance(entry.effect, StribeckFriction)]
    directions = sweep(Ground.of(servos, recorded(servos, 400)).rough(()), entries[:1])
    trials = [tuple(one.trial.values()) for one in directions]
    assert len(set(trials)) == len(trials) == 4  # of a torque and of a share of the load, at two speeds
    for one in directions:
        half = one.effect(0.5)
        assert (half.torque, half.share) == pytest.approx((0.5 * one.trial["torque"], 0.5 * one.trial["share"]))
        assert half.speed == one.trial["speed"]


def test_joints_that_were_refused_together_are_not_tried_again_beside_one_of_them():
    ground = Ground.of(SIMULATION, recorded(SIMULATION.with_effects(*EACH_JOINT), 1200, noise=0.01))
    friction = JointFrictionLoss(EACH_JOINT[0].torque, "shoulder")
    less = ground.found((entry_of(friction, CATALOGUE),), (friction,))
    entries = [entry for entry in CATALOGUE if getattr(entry.effect, "joints", None) in ("shoulder", "elbow")]
    candidates = Candidates.of(ground, less, sweep(ground.rough(less.effects), entries, less.effects))
    together = max(with_one_more(ground, candidates), key=lambda one: len(one.entries))
    refused = together.names - less.names
    assert len(refused) > 2
    assert refused not in [one.names - less.names for one in with_one_more(ground, candidates, [refused])]


def test_in_an_effects_place_only_candidates_are_fitted_that_gain_a_part_of_what_it_gains(monkeypatch):
    ground = Ground.of(SIMULATION, recorded(SIMULATION.with_effects(Gravity(1.3)), 800))
    gravity, nothing = (
        ground.found(*pair) for pair in (((entry_of(Gravity(), CATALOGUE),), (Gravity(1.3),)), ((), ()))
    )
    candidates = Candidates.of(ground, nothing, sweep(ground.rough(()), CATALOGUE))
    rough, fitted = candidates.rough, []
    assert candidates.gains.score == pytest.approx(rough.score(()))
    monkeypatch.setattr("torchrl_h2o.residuals.grow._sketched", lambda _, __, sets: fitted.append(sets) or [])
    for part in (-1e9, 0.1, 0.9):
        monkeypatch.setattr("torchrl_h2o.residuals.grow.PART", part)
        with_one_more(ground, candidates, instead_of=gravity)
    every, some, few = fitted
    assert len(every) > len(some) >= len(few)
    gains = [rough.score(effects) - rough.score(()) for _, effects in some]
    assert min(gains, default=1e9) > 0.1 * (rough.score((Gravity(1.3),)) - rough.score(()))
    assert all("Gravity" not in (one.name for one in entries) for entries, _ in every)


def test_of_sets_that_explain_equally_well_the_one_of_all_joints_is_taken():
    of_all, of_one = (
        Found((entry_of(effect, CATALOGUE),), (effect,), scores)
        for effect, scores in (
            (JointFrictionLoss(0.1), np.array([1.0, 2.0, 3.0, 4.0, 5.0])),
            (JointFrictionLoss(0.1, "elbow"), np.array([1.2, 2.3, 2.9, 4.1, 5.0])),
        )
    )
    assert most_usual([of_one, of_all]) is of_all
    assert is_preferred(of_all, of_one)


def test_an_effect_that_is_there_acts_on_the_elements_with_the_best_score():
    def with_friction(joints, mean):
        effect = JointFrictionLoss(0.1, joints)
        return Found((entry_of(effect, CATALOGUE),), (effect,), mean + 0.01 * np.arange(20.0) % 0.07)

    nothing = Found((), (), np.zeros(20))
    of_all, of_one = with_friction("*", 9.0), with_friction("elbow", 6.0)
    delay = Found((entry_of(ActionDelay(0.1), CATALOGUE),), (ActionDelay(0.1),), np.full(20, 12.0))
    assert on_best_elements([of_one], [delay, of_all, of_one], nothing) is of_all
    assert on_best_elements([of_all], [delay, of_all, of_one], nothing) is of_all


def test_a_search_puts_an_effect_on_the_elements_with_the_best_score_if_the_rows_for_selection_agree(monkeypatch):
    """The one of all joints lacks evidence, as one of many that errors of noisy commands hide may do."""
    nothing = Found((), (), np.zeros(20))
    of_one, of_all, against = (
        Found((entry_of(effect, CATALOGUE),), (effect,), np.full(20, mean))
        for effect, mean in (
            (JointFrictionLoss(0.1, "elbow"), 6.0),
            (JointFrictionLoss(0.1), 9.0),
            (JointFrictionLoss(0.1, "shoulder"), 12.0),
        )
    )
    monkeypatch.setattr(Candidates, "of", lambda *args: None)
    monkeypatch.setattr("torchrl_h2o.residuals.grow.with_one_more", lambda *args, **options: [of_one, of_all, against])
    ground = SimpleNamespace(
        adds=lambda one, less, among: one is of_one and less is nothing,
        agrees=lambda one, less: one is not against,
        fitted=lambda entries, effects: next(one for one in (of_one, of_all, against) if one.effects == effects),
        leaves_little=lambda found: True,
    )
    assert grow(ground, nothing, [], lambda *args: None, {}) is of_all


def test_the_estimated_gain_of_a_lead_counts_how_small_the_errors_become():
    simulation = SIMULATION.quick
    measured = recorded(simulation.with_effects(Gravity(0.5), ActionGain(1.4, (1,))), 800)
    ground = Ground.of(simulation, measured)
    rough = ground.rough(())
    (direction,) = sweep(rough, [entry for entry in CATALOGUE if isinstance(entry.effect, Gravity)])
    (lead,) = gains_beside(rough, ground.found((), ())).leads([direction])
    gravity = direction.effect(lead.shares[0])
    assert gravity.scale == pytest.approx(0.5, abs=0.01)
    assert lead.gain == pytest.approx(rough.score([gravity]) - rough.score(), rel=0.1)


def test_a_lead_that_acts_in_few_blocks_counts_though_its_estimate_is_inexact():
    """The other blocks have hardly any error, and lose by the variance that the errors of the estimate ask for."""
    size, rng = 400, np.random.default_rng(0)
    block, change = np.repeat(np.arange(20), size // 20), np.where(np.arange(size) < 100, 1e4, 0.0)
    change *= rng.standard_normal(size)
    ones, none = np.ones(size), np.zeros((size, 0))
    entry = SIMULATION.catalogue()[0]
    white = -change * (1.0 + 0.01 * rng.standard_normal(size)) + 1e-3 * rng.standard_normal(size)
    (lead,) = Gains(white, ones, ones, none, block, np.zeros(size, int), ones).leads(
        [Direction(entry, entry.trials[-1], change)]
    )
    assert lead.evidence > 3.0


def test_two_candidates_are_tried_together_that_explain_little_one_by_one():
    size, rng = 400, np.random.default_rng(0)
    common, apart, other = rng.standard_normal((3, size))
    pair = [common + 0.1 * apart, common - 0.1 * apart]
    alike = [other + 0.5 * rng.standard_normal(size) for _ in range(12)]  # 66 pairs, more than are looked at closely
    entries = SIMULATION.catalogue()
    directions = [Direction(one, one.trials[-1], change) for one, change in zip(entries, pair + alike, strict=False)]
    block, group = np.repeat(np.arange(20), size // 20), np.zeros(size, int)
    ones, none = np.ones(size), np.zeros((size, 0))
    gains = Gains(5.0 * (pair[1] - pair[0]) + 0.4 * other, ones, ones, none, block, group, ones)
    leads = gains.leads(directions)
    best, *_ = gains.pairs(leads)
    assert not leads[0].names & best.names
    assert best.names == {one.name for one in entries[:2]}
    assert best.gain > 2.0 * leads[0].gain


def test_the_present_values_are_readjusted_to_a_candidate_before_it_is_simulated():
    """Damping that was fitted in the place of a gravity is too large beside this gravity."""
    measured = recorded(SIMULATION.with_effects(Gravity(0.7), JointDamping(0.02, "elbow")), 1200, noise=0.001)
    ground, entry = Ground.of(SIMULATION, measured), entry_of(JointDamping(0.02, "elbow"), CATALOGUE)
    less = ground.fitted([entry], [JointDamping(0.02, "elbow")])
    directions = sweep(ground.rough(less.effects), [e for e in CATALOGUE if e.name == "Gravity"], less.effects)
    candidates = Candidates.of(ground, less, directions)
    (lead,) = candidates.leads
    moved, *_, alone = (effects for _, effects in candidates.sizes(lead))
    assert moved[0] != alone[0] == less.effects[0]
    assert candidates.rough.score(moved) > candidates.rough.score(alone)


def test_derivatives_are_those_of_euler_steps_where_the_model_has_four_evaluations_a_step():
    measured = recorded(SIMULATION.with_effects(Gravity(0.9)), 800)
    rough = Ground.of(SIMULATION, measured).rough(())
    (direction,) = sweep(rough, [entry for entry in CATALOGUE if isinstance(entry.effect, Gravity)])
    exact = flat(rough.errors([direction.effect(1.0)])) - flat(rough.errors())
    assert 0.001 < np.median(np.abs(direction.change - exact)) / np.median(np.abs(exact)) < 0.1
    one = pendulum()
    assert one.quick is one


def test_of_sets_that_explain_the_data_equally_the_one_with_fewer_values_is_taken():
    """A payload with its place has two values more than a mass, and takes up what other missing effects cause."""
    catalogue, scores = double_pendulum().catalogue(), np.random.default_rng(0).normal(size=20)
    mass, payload = (
        next(entry for entry in catalogue if type(entry.effect) is kind and len(entry.fitted) == values)
        for kind, values in ((BodyMass, 1), (Payload, 3))
    )
    sets = [Found((entry,), (entry.starts[0],), scores + better) for entry, better in ((mass, 0.0), (payload, 1e-3))]
    assert sets[1].surprise == sets[0].surprise + 2
    assert most_usual(sets) is sets[0]


def test_the_most_unusual_of_a_kind_counts_and_each_term_of_a_force():
    assert surprise_of([JointFrictionLoss(0.1, "shoulder"), ActionBias(0.1)]) == 0
    assert surprise_of([BodyMass(1.1, "upper"), BodyMass(1.2, "lower")]) == surprise_of([BodyMass(1.1, "upper")]) == 1
    one, two = (JointForce(0.1, "shoulder"),), (JointForce(0.1, "shoulder"), JointForce(0.2, "elbow"))
    assert surprise_of(two) == 2 * surprise_of(one)  # joints have friction in common, but not forces
    one, two = (ResidualForce(("torque on elbow: 0.1 · t",) * n) for n in (1, 2))
    assert 0 < surprise_of([one]) < surprise_of([two])


def test_an_unusual_set_needs_more_evidence_to_take_the_place_of_a_usual_one():
    usual = Found((entry_of(JointDamping(0.01), CATALOGUE),), (JointDamping(0.01),), np.zeros(40))
    unusual = Found((entry_of(Gravity(0.9), CATALOGUE),), (Gravity(0.9),), np.zeros(40))
    scatter = np.random.default_rng(0).standard_normal(40)
    scatter -= scatter.mean()
    for gain, is_better in ((0.5, False), (1.0, True)):
        better = replace(unusual, scores=scatter + gain)
        assert Difference(better.scores).evidence > 3.0
        assert is_preferred(better, usual) == is_better
        assert (most_usual([usual, better]) is better) == is_better


def test_damping_and_a_rotor_are_one_choice_and_two_other_effects_are_two():
    entries = {type(entry.effect): entry for entry in CATALOGUE}

    def more(*effects):
        return Found(tuple(entries[type(effect)] for effect in effects), effects, np.zeros(0))

    assert choices(30, more(JointDamping(0.1), Armature(0.1)), more()) == 30
    assert choices(30, more(JointDamping(0.1), Gravity(0.9)), more()) == 900
    assert choices(30, more(ActionGain(0.9), Gravity(0.9)), more()) == 900
    assert choices(30, more(ActionGain(0.9), Gravity(0.9)), more(Gravity(0.9))) == 30
