"""An alternative takes an effect's place if it makes another effect unnecessary."""

from dataclasses import replace

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionGain, BodyMass, CatalogueEntry, Gravity, JointDamping
from torchrl_h2o.residuals.trace.outcome import Attempt
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.simplify import spare
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = pendulum()  # damping 0.1 N·m·s/rad
FACTORS = ({"scale": 0.8}, {"scale": 1.25})
GAIN, MASS = CatalogueEntry(ActionGain(), FACTORS), CatalogueEntry(BodyMass(), FACTORS)
GRAVITY = CatalogueEntry(Gravity(), FACTORS)
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 0.04}, {"damping": 0.2}))
ENTRIES = [GAIN, DAMPING]


def found(*truth, noise, alternative):
    """A search that has found a motor's gain and damping, with an alternative in the place of the gain."""
    measured = recorded(SIMULATION.with_effects(*truth), 1000, noise=noise)
    begun = SearchState.begin(
        Problem.pose(SIMULATION, measured), [GAIN, MASS, GRAVITY, DAMPING], np.random.default_rng(0)
    )
    state = begun.with_found(ENTRIES, begun.refitted(ENTRIES, [ActionGain(1.5), JointDamping(0.05)]))
    instead = state.refitted(
        [alternative, DAMPING], [alternative.effect.with_parameters({"scale": 0.7}), JointDamping(0.01)]
    )
    attempt = Attempt(alternative, instead, 0, instead.loss, 1.0)
    return replace(state, groups=((attempt,), ()), rivals={GAIN.name: (), DAMPING.name: ()})


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.01])
def test_a_lighter_arm_needs_no_damping_beside_it(noise):
    """u = m l² q̈ + m g l sin q + d q̇: with 0.6 m, motors × 1.67 and more damping look the same."""
    state = spare(found(BodyMass(0.6), noise=noise, alternative=MASS))
    assert state.entries == (MASS,)
    assert state.fit.effects[0].scale == pytest.approx(0.6, rel=0.02)
    assert state.groups == ()


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.01])
def test_effects_stay_that_the_alternative_needs_as_well(noise):
    state = found(BodyMass(0.6), JointDamping(0.2), noise=noise, alternative=MASS)
    assert spare(state) is state


def test_an_alternative_that_explains_less_is_not_taken():
    state = found(BodyMass(0.6), noise=0.01, alternative=GRAVITY)
    assert spare(state) is state


def test_effects_without_alternatives_stay():
    state = replace(found(BodyMass(0.6), noise=0.0, alternative=MASS), groups=((), ()))
    assert spare(state) is state
