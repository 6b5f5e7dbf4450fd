"""Additions to a list of effects, and the lists that grow side by side."""

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from torchrl_h2o.effects import BodyMass, ObservationBias
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import Measured, Simulation
from torchrl_h2o.residuals.trace.add import additions, pairs_by_prediction
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.state import SearchState

HEAVY, TILTED = BodyMass(2.27, bodies="torso"), ObservationBias(0.057, entries=(0,))
TRUE = {"BodyMass torso", "ObservationBias 0"}
OTHERS = {"Armature axle", "BodyCentreOfMass wheels", "BodyMass wheels", "JointForce axle", "GeomSize *wheel*"}


@pytest.fixture(scope="module")
def state():
    simulation = Simulation.from_env(WheelLeggedEnv())
    reality = TransformedEnv(WheelLeggedEnv(max_episode_steps=500), DynamicsGap(HEAVY, TILTED))
    measured = Measured.from_ted(record(reality, noisy_balance_controller(), 2000, seed=0), simulation)
    catalogue = [entry for entry in simulation.catalogue() if entry.name in TRUE | OTHERS]
    return SearchState.begin(Problem.pose(simulation, measured), catalogue, np.random.default_rng(0))


def names(entries):
    return {entry.name for entry in entries}


def test_a_pair_is_found_whose_first_effect_alone_is_far_from_the_best(state):
    """Alone, a heavier torso explains less than moved wheels do. With a tilted sensor it explains everything."""
    rng = np.random.default_rng(0)
    leads = screen(state.problem, (), state.catalogue, state.windows.screened)
    singles = additions(state, leads, rng)
    assert "BodyMass torso" not in {one.entries[0].name for one in singles.near}
    pairs = pairs_by_prediction(singles, singles.near[0].loss, rng)
    assert names(pairs.near[0].entries) == TRUE
    assert pairs.near[0].loss < 0.1 * singles.near[0].loss


def test_pairs_that_do_not_come_close_to_other_lists_are_left_out(state):
    rng = np.random.default_rng(0)
    leads = screen(state.problem, (), state.catalogue, state.windows.screened)
    assert not pairs_by_prediction(additions(state, leads, rng), 1e-6, rng).passed
