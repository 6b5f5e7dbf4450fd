"""A named gap beside another version of the simulator."""

from dataclasses import replace

import numpy as np
import pytest
from cases import draw_case
from running import FAMILIES
from systems import SYSTEMS
from undeclared_effects import OtherVersion

from tests.recipes.benchmarks.made_up import report
from torchrl_h2o.effects import ActionGain, Gravity
from torchrl_h2o.residuals import Measured, Simulation, residuals

SEED = 5


def test_another_version_changes_all_inertias_and_dampings_a_little_and_nothing_else():
    simulation = Simulation.from_env(SYSTEMS["HalfCheetah"].env())
    plain, other = simulation.model, simulation.with_effects(OtherVersion(3)).model
    inertia = np.abs(np.sort(other.body_inertia[1:]) / np.sort(plain.body_inertia[1:]) - 1.0)
    assert ((inertia > 0.019) & (inertia < 0.061)).all()
    damped = plain.dof_damping > 0.0
    damping = np.abs(other.dof_damping[damped] / plain.dof_damping[damped] - 1.0)
    assert ((damping > 0.009) & (damping < 0.031)).all()
    np.testing.assert_allclose(other.body_mass, plain.body_mass)
    np.testing.assert_allclose(other.body_ipos, plain.body_ipos, atol=1e-12)
    assert (simulation.with_effects(OtherVersion(4)).model.body_inertia != other.body_inertia).any()


@pytest.mark.parametrize("number", [0, *(pytest.param(number, marks=pytest.mark.slow) for number in range(1, 10))])
def test_the_gap_stands_out_of_the_difference_of_versions(number):
    case = replace(draw_case(FAMILIES, "versions", number, SEED), transitions=1500)
    simulation = case.simulation()
    measured = Measured.from_ted(case.measure(), simulation)
    starts = measured.windows(1)
    nothing, gap, both = (
        residuals(simulation.with_effects(*effects), measured, starts)[:, 0] ** 2
        for effects in ((), case.truth[:1], case.truth)
    )
    largest = nothing.mean(0).argmax()
    assert both.mean(0)[largest] < 0.1 * gap.mean(0)[largest] < 0.1 * 0.5 * nothing.mean(0)[largest]


def test_a_version_passes_with_the_gap_within_a_tenth_whatever_stands_for_the_rest():
    case = draw_case(FAMILIES, "versions", 0, SEED)
    (gap, _) = case.truth
    assert isinstance(gap, Gravity)
    assert case.judge(report(replace(gap, scale=1.09 * gap.scale), ActionGain(0.99)), case)["ok"]
    assert not case.judge(report(replace(gap, scale=1.11 * gap.scale)), case)["ok"]
    assert not case.judge(report(ActionGain(0.9)), case)["ok"]
