"""In noisy data, the search and its last fit use windows of several steps."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import CatalogueEntry, JointDamping, JointFrictionLoss, ObservationDelay
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar
from torchrl_h2o.residuals.trace.choose_horizon import fitted_in_longer_windows
from torchrl_h2o.residuals.trace.fit import fit
from torchrl_h2o.residuals.trace.problem import Problem

TRUE = {"damping": 0.05, "torque": 0.12}
CATALOGUE = (
    CatalogueEntry(JointDamping(), ({"damping": 0.01}, {"damping": 0.1})),
    CatalogueEntry(JointFrictionLoss(), ({"torque": 0.01}, {"torque": 0.1})),
    CatalogueEntry(ObservationDelay(entries=(1,)), ({"delay": 0.002},)),
)


def one_step_fit(noise: float, seed: int, rows: int = 1500):
    """Friction and damping, fitted in windows of one step with states that were estimated with friction alone."""
    real = pendulum().with_effects(JointFrictionLoss(TRUE["torque"]), JointDamping(TRUE["damping"]))
    posed = Problem.pose(pendulum().with_effects(JointFrictionLoss(0.18)), recorded(real, rows, noise=noise, seed=seed))
    problem = replace(posed, simulation=pendulum())
    starts = problem.measured.fitted()
    return problem, fit(problem, (JointDamping(0.1), JointFrictionLoss(0.1)), (("damping",), ("torque",)), starts)


def test_friction_and_damping_in_noisy_data_get_their_values():
    problem, short = one_step_fit(0.03, 0)
    longer = fitted_in_longer_windows(problem, short)
    errors = [
        [abs(one.parameters[name].value / TRUE[name] - 1.0) for one, name in zip(found.effects, TRUE, strict=True)]
        for found in (short, longer)
    ]
    assert max(errors[1]) < 0.08 < max(errors[0])
    for index, name in enumerate(TRUE):
        low, high = longer.ci95(index)[name]
        assert low < TRUE[name] < high


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_the_search_finds_friction_and_damping_in_noisy_data(seed):
    """In windows of one step it finds a late velocity sensor as well (seed 0), or friction of 0.185 N·m alone (2)."""
    real = pendulum().with_effects(JointFrictionLoss(TRUE["torque"]), JointDamping(TRUE["damping"]))
    measured = recorded(real, noise=0.03, seed=seed)
    with LoopBar(disable=True) as bar:
        trace = trace_effects(pendulum(), measured, CATALOGUE, rng=np.random.default_rng(0), progress=bar)
    found = {type(effect): effect for effect in trace.fit.effects}
    assert found.keys() == {JointDamping, JointFrictionLoss}
    assert found[JointDamping].damping == pytest.approx(TRUE["damping"], rel=0.05)
    assert found[JointFrictionLoss].torque == pytest.approx(TRUE["torque"], rel=0.05)
    assert trace.horizon == 1  # forces are still looked for in windows of the chosen length


def test_a_fit_to_data_without_noise_stays():
    problem, short = one_step_fit(0.0, 0)
    assert problem.sensor_std is None
    assert fitted_in_longer_windows(problem, short) is short
    np.testing.assert_allclose([short.effects[0].damping, short.effects[1].torque], list(TRUE.values()), rtol=1e-3)


def test_too_few_longer_windows_are_not_fitted():
    problem, short = one_step_fit(0.03, 0, rows=200)
    assert fitted_in_longer_windows(problem, short) is short
