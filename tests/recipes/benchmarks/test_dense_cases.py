"""Chains of many joints: the truth explains their logs, and what a report must name."""

from dataclasses import replace

import numpy as np
import pytest
from cases import draw_case
from dense_cases import KINDS, judge_dense
from running import FAMILIES

from tests.recipes.benchmarks.made_up import report
from torchrl_h2o.effects import ActionDelay, ObservationDelay
from torchrl_h2o.residuals import Measured, residuals

SEED, ROWS = 5, 1000
NUMBERS = [0, 1, *(pytest.param(number, marks=pytest.mark.slow) for number in (2, 3))]


def short(number):
    return replace(draw_case(FAMILIES, "dense", number, SEED), transitions=ROWS)


def rms(values):
    return np.sqrt((values**2).mean(0))


@pytest.mark.parametrize("number", NUMBERS)
def test_the_truth_explains_the_log_of_a_chain_to_within_its_noise(number):
    """The library did not simulate the log; its physics steps are five times as long."""
    case = short(number)
    simulation, (states, _) = case.simulation(), case.machine.record(ROWS, case.seed)
    measured = Measured.from_ted(case.measure(), simulation)
    nothing, truth = (
        rms(residuals(simulation.with_effects(*effects), measured, np.arange(ROWS), states=states[:-1])[:, 0])
        / (case.noise * measured.observation.std(0))
        for effects in ((), case.truth)
    )
    assert (truth < 2.0).all()
    assert (truth < 1.1 * nothing).all()
    assert (truth < 0.5 * nothing).any()


@pytest.mark.parametrize("number", NUMBERS)
def test_a_chain_moves_within_its_range_and_its_log_has_what_it_should(number):
    case = short(number)
    count = len(case.machine.joints)
    data = case.measure()
    assert 6 <= count <= 12
    assert data["observation"].shape == (ROWS, count if number == 1 else 2 * count)
    angles = data["observation"][:, :count].numpy()
    assert np.abs(angles).max(0).min() > 0.3
    assert np.abs(angles).max() < 2.0
    assert np.array_equal(data["next", "observation"][:-1], data["observation"][1:])
    model = case.simulation().model
    assert not model.dof_frictionloss.any()
    assert not model.dof_damping.any()
    assert not model.dof_armature.any()


def test_every_effect_of_a_chain_can_be_seen():
    """One step's change of each is at least a fifth of the noise of some sensor, in 5,000 rows."""
    case = short(0)
    simulation = case.simulation().with_effects(*case.truth)
    measured = Measured.from_ted(case.measure(), simulation)
    starts = measured.windows(1)
    noise, whole = case.noise * measured.observation.std(0), residuals(simulation, measured, starts)[:, 0]
    for left_out in case.truth:
        others = [effect for effect in case.truth if effect is not left_out]
        change = residuals(case.simulation().with_effects(*others), measured, starts)[:, 0] - whole
        assert (rms(change) / noise).max() > 0.2


def scaled(case, factor):
    """The truth, but with the friction of the second joint times a factor."""
    friction = case.truth[3]
    return tuple(replace(e, torque=factor * e.torque) if e is friction else e for e in case.truth)


def with_interval(case, factor, low, high):
    found = report(*scaled(case, factor))
    torque = factor * case.truth[3].torque
    wider = [
        replace(one, ci95={"torque": (low * torque, high * torque)}) if one.effect == scaled(case, factor)[3] else one
        for one in found.found
    ]
    return replace(found, found=tuple(wider))


def test_a_chain_passes_with_values_within_a_quarter_or_in_their_intervals():
    case = short(0)
    assert judge_dense(report(*case.truth), case)["ok"]
    assert judge_dense(report(*scaled(case, 1.2)), case)["ok"]
    assert not judge_dense(report(*scaled(case, 1.4)), case)["ok"]
    assert judge_dense(with_interval(case, 1.4, 0.7, 1.3), case)["ok"]
    assert not judge_dense(with_interval(case, 1.4, 0.9, 1.1), case)["ok"]
    assert not judge_dense(report(*case.truth[1:]), case)["ok"]
    assert {type(effect) for effect in case.truth} == {*KINDS, ActionDelay}


@pytest.mark.parametrize(("error", "passes"), [(0.0008, True), (0.0012, False)])
def test_a_chain_s_delay_is_right_within_a_millisecond_whether_motors_or_sensors_are_late(error, passes):
    case = short(0)
    late = case.truth[-1].delay + error
    for delay in (ActionDelay(late), ObservationDelay(late)):
        assert judge_dense(report(*case.truth[:-1], delay), case)["ok"] is passes
