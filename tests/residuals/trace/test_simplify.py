"""The simplification of effects: another effect takes the place of one that only seemed to be as good."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from tests.residuals.pendulum import pendulum, recorded
from torchrl_h2o.effects import (
    ActionDelay,
    ActionGain,
    BodyMass,
    CatalogueEntry,
    JointFrictionLoss,
    ObservationDelay,
    RollingResistance,
)
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import Lead, screen
from torchrl_h2o.residuals.trace.simplify import simplify, simplify_one
from torchrl_h2o.residuals.trace.state import SearchState

LATE = CatalogueEntry(ActionDelay(), ({"delay": 0.01},))
SENSORS = CatalogueEntry(ObservationDelay(), ({"delay": 0.01},))
FACTORS = ({"scale": 0.8}, {"scale": 1.25})
GAIN = CatalogueEntry(ActionGain(), FACTORS)
TORSO = CatalogueEntry(BodyMass(bodies="torso"), FACTORS)
OTHERS = (ActionDelay(0.0125), RollingResistance(0.003, geoms="*wheel*"), JointFrictionLoss(0.12, joints="axle"))
ENTRIES = (
    CatalogueEntry(ActionDelay(), ({"delay": 0.01},)),
    CatalogueEntry(RollingResistance(geoms="*wheel*"), ({"coefficient": 0.002},)),
    CatalogueEntry(JointFrictionLoss(joints="axle"), ({"torque": 0.1},)),
)


@pytest.fixture
def late_motors():
    """A search that has found late motors, whose delay is a little off, with late sensors as their rival."""
    simulation = pendulum()
    measured = recorded(simulation.with_effects(ActionDelay(0.013)), 400)
    begun = SearchState.begin(Problem.pose(simulation, measured), [LATE, SENSORS], np.random.default_rng(0))
    found = begun.with_found(
        [LATE], replace(begun.refitted([LATE], [ActionDelay(0.013)]), effects=(ActionDelay(0.0130001),))
    )
    lead = Lead(SENSORS, ObservationDelay(0.013), promise=1.0, trial={"delay": 0.01}, change=np.zeros(1))
    return replace(found, rivals={LATE.name: [lead]})


def test_an_alternative_that_is_better_by_rounding_does_not_take_an_effects_place(late_motors):
    """Late motors and late sensors took turns, and each time all alternatives were looked for again."""
    state, alternatives = simplify_one(late_motors, 0)
    assert state.entries == (LATE,)
    (sensors,) = alternatives
    assert sensors.entry is SENSORS
    assert sensors.loss < state.selection_losses(late_motors.fit.effects).mean()


def test_alternatives_beside_the_same_effects_are_looked_for_once(late_motors):
    tried = []
    first = simplify(late_motors, lambda: tried.append(1))
    assert tried == [1]
    again = simplify(first, lambda: tried.append(1))
    assert tried == [1]
    assert again.groups == first.groups
    assert again.groups[0][0].entry is SENSORS


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
