"""The simplification of effects: another effect takes the place of one that only seemed to be as good."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from torchrl_h2o.effects import ActionDelay, ActionGain, BodyMass, CatalogueEntry, JointFrictionLoss, RollingResistance
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.simplify import simplify_one
from torchrl_h2o.residuals.trace.state import SearchState

FACTORS = ({"scale": 0.8}, {"scale": 1.25})
GAIN = CatalogueEntry(ActionGain(), FACTORS)
TORSO = CatalogueEntry(BodyMass(bodies="torso"), FACTORS)
OTHERS = (ActionDelay(0.0125), RollingResistance(0.003, geoms="*wheel*"), JointFrictionLoss(0.12, joints="axle"))
ENTRIES = (
    CatalogueEntry(ActionDelay(), ({"delay": 0.01},)),
    CatalogueEntry(RollingResistance(geoms="*wheel*"), ({"coefficient": 0.002},)),
    CatalogueEntry(JointFrictionLoss(joints="axle"), ({"torque": 0.1},)),
)


@pytest.mark.slow
def test_a_heavier_torso_takes_the_place_of_weaker_motors():
    """Residuals scaled by their size without the motors hide that a heavier torso leaves smaller ones."""
    reality = TransformedEnv(WheelLeggedEnv(), DynamicsGap(*OTHERS, BodyMass(1.2, bodies="torso")))
    simulation = Simulation.from_env(WheelLeggedEnv())
    measured = Measured.from_ted(record(reality, noisy_balance_controller(), 3000, seed=0), simulation)
    problem = Problem.pose(simulation, measured)
    state = SearchState.begin(problem, [*ENTRIES, GAIN, TORSO], np.random.default_rng(0))
    leads = screen(problem, OTHERS, [GAIN, TORSO], state.windows.screened)
    found = [*ENTRIES, GAIN]
    state = state.with_found(found, state.refitted(found, [*OTHERS, ActionGain(0.87)]))
    simplified, _ = simplify_one(replace(state, rivals={GAIN.name: leads}), 3)
    assert simplified.entries[3] is TORSO
