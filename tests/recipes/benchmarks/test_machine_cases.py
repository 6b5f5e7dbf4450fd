"""Machines with several faults: their logs follow from the faults that the benchmark asks for."""

import numpy as np
import pytest
from cases import draw_case
from machine_cases import judge_machine
from running import FAMILIES

from torchrl_h2o.effects import ActionBias, ActionLag, Gravity, JointForce, JointSpring, ObservationDelay
from torchrl_h2o.residuals import Measured, residuals
from torchrl_h2o.residuals.report.contents import DataSummary, FoundEffect, IndistinguishableGroup
from torchrl_h2o.residuals.report.document import Report

SEED = 5


@pytest.mark.parametrize("number", [0, *(pytest.param(each, marks=pytest.mark.slow) for each in (2, 6, 8, 10, 14, 16))])
def test_the_faults_of_a_machine_explain_its_log(number):
    """100 ms ahead, with the true faults and the filter's delay; the library did not simulate the log."""
    case = draw_case(FAMILIES, "machines", number, SEED)
    simulation = case.simulation()
    measured = Measured.from_ted(case.measure(), simulation)
    joints = len(case.joints)
    late = ObservationDelay(case.machine.filter_time, tuple(range(joints, 2 * joints)))
    steps = round(0.1 / case.machine.step)
    starts = measured.windows(steps, steps)
    before, after = (
        np.median(np.abs(residuals(which, measured, starts, steps)[:, -1, :joints]), axis=0)
        for which in (simulation.with_effects(late), simulation.with_effects(*case.truth, late))
    )
    assert (after < 0.5 * before).any()
    assert (after < 1.05 * before).all()


@pytest.mark.parametrize(
    ("more", "passes"), [((), True), ((ActionLag(0.006),), True), ((ActionLag(0.02),), False), ((Gravity(1.1),), False)]
)
def test_a_machine_is_right_with_all_faults_and_no_more_than_lateness(more, passes):
    case = draw_case(FAMILIES, "machines", 6, SEED)
    bias = ActionBias(0.24, (2,))
    found = (JointSpring(0.8, "knee"), bias, *more)
    groups = (IndistinguishableGroup((bias, JointForce(0.24, "knee")), (0.0, 0.0)),)
    report = Report(
        simulator="made up",
        data=DataSummary("made up", 100, 30),
        found=tuple(FoundEffect(effect, True, {}, 0.0) for effect in found),
        indistinguishable=groups,
    )
    assert judge_machine(report, case)["ok"] is passes
