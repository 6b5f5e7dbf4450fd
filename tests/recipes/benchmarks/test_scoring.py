"""The scores of the benchmark of close_the_loop: what counts as found in a report."""

from dataclasses import replace

import numpy as np
import pytest
from cases import draw_case
from running import FAMILIES
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
from systems import SYSTEMS

from tests.recipes.benchmarks.made_up import report
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
from torchrl_h2o.residuals import Simulation
from torchrl_h2o.residuals.report.contents import OtherExplanation

SEED = 5


@pytest.fixture(scope="module")
def cheetah():
    return Simulation.from_env(SYSTEMS["HalfCheetah"].env())


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
    listed = [OtherExplanation((gain,), 0.0), OtherExplanation((gravity, mass), 0.0)]
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


def test_slow_effects_pass_by_their_friction_or_by_a_torque_in_time():
    viscous, drift = (draw_case(FAMILIES, "slow", number, SEED) for number in (0, 1))
    assert viscous.judge(report(*viscous.truth), viscous)["ok"]
    assert not viscous.judge(report(JointSpring(0.1, joints="pivot")), viscous)["ok"]
    grows = ResidualForce(("torque on pivot: 0.01 · t",))
    pulls = ResidualForce(("torque on pivot: 0.01 · sin(7 q)",))
    assert drift.judge(report(grows), drift)["ok"]
    assert not drift.judge(report(pulls), drift)["ok"]
    assert not drift.judge(report(grows, *viscous.truth), drift)["ok"]
