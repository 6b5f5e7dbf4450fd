"""The same effect on each of several joints."""

import numpy as np
import pytest

from tests.residuals.pendulum import double_pendulum, recorded
from torchrl_h2o.effects import Armature, CatalogueEntry, Gravity, JointFrictionLoss
from torchrl_h2o.residuals.trace.families import entries_of_elements, number_of_effects
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.state import SearchState

SIMULATION = double_pendulum()
TRIALS = ({"torque": 0.02}, {"torque": 0.1})
ALL, SHOULDER, ELBOW = (CatalogueEntry(JointFrictionLoss(joints=j), TRIALS) for j in ("*", "shoulder", "elbow"))
ROTOR = CatalogueEntry(Armature(joints="elbow"), ({"inertia": 0.01},))
GRAVITY = CatalogueEntry(Gravity(), ({"scale": 0.8},))
CATALOGUE = (SHOULDER, ELBOW, ALL, ROTOR, GRAVITY)


def test_elements_of_an_effect_on_several_joints():
    assert entries_of_elements(ALL, CATALOGUE, SIMULATION) == (SHOULDER, ELBOW)
    assert entries_of_elements(ALL, (SHOULDER, ALL), SIMULATION) == ()
    assert entries_of_elements(ELBOW, CATALOGUE, SIMULATION) == ()


@pytest.mark.parametrize(
    ("entries", "number"),
    [
        ((), 0),
        ((SHOULDER, GRAVITY), 2),
        ((SHOULDER, ROTOR), 2),
        ((SHOULDER, ELBOW, GRAVITY), 2),
        ((SHOULDER, ELBOW, ALL), 2),
        ((SHOULDER, ELBOW, ROTOR), 2),
    ],
)
def test_the_same_effect_on_single_joints_counts_as_one(entries, number):
    problem = Problem.pose(SIMULATION, recorded(SIMULATION, 600))
    state = SearchState.begin(problem, CATALOGUE, np.random.default_rng(0))
    assert number_of_effects(state.with_found(entries, state.fit)) == number
