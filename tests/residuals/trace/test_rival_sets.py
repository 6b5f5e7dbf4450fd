"""Other sets of effects that explain the data as well: listed, and the most usual one is put in."""

import numpy as np
import pytest

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import ActionGain, BodyMass, CatalogueEntry, Gravity, JointDamping
from torchrl_h2o.residuals import trace_effects
from torchrl_h2o.residuals.progress import LoopBar

SIMULATION = pendulum()  # damping 0.1 N·m·s/rad
FACTORS = ({"scale": 0.5}, {"scale": 0.8}, {"scale": 1.25}, {"scale": 2.0})
MASS, GAIN = CatalogueEntry(BodyMass(), FACTORS), CatalogueEntry(ActionGain(), FACTORS)
DAMPING = CatalogueEntry(JointDamping(), ({"damping": 0.04}, {"damping": 0.2}))
GRAVITY = CatalogueEntry(Gravity(), FACTORS)


def traced(*truth, catalogue, noise=0.002):
    measured = recorded(SIMULATION.with_effects(*truth), 1500, noise=noise)
    with LoopBar(disable=True) as progress:
        return trace_effects(SIMULATION, measured, catalogue, rng=np.random.default_rng(0), progress=progress)


def kinds(effects):
    return {type(effect) for effect in effects}


@pytest.mark.slow
def test_a_weak_motor_and_a_heavier_arm_with_more_damping_are_both_named():
    """u = m l² q̈ + m g l sin q + d q̇: half the torque has the effect of twice the mass and twice the damping."""
    trace = traced(ActionGain(0.55), catalogue=[GAIN, MASS, DAMPING])
    named = [kinds(trace.fit.effects), *(kinds(other.fit.effects) for other in trace.others)]
    assert {ActionGain} in named
    assert {BodyMass, JointDamping} in named
    surprises = [other.surprise for other in trace.others]
    assert surprises == sorted(surprises)


@pytest.mark.slow
def test_an_explanation_without_a_rival_stands_alone():
    trace = traced(Gravity(1.4), catalogue=[GRAVITY, DAMPING])
    assert trace.fit.effects[0].scale == pytest.approx(1.4, rel=0.02)
    assert trace.others == ()


def test_data_without_noise_are_explained_exactly_and_have_no_rivals():
    trace = traced(ActionGain(0.55), catalogue=[GAIN, GRAVITY, DAMPING], noise=0.0)
    assert kinds(trace.fit.effects) == {ActionGain}
    assert trace.others == ()
