"""Pairs of effects whose first effect, alone, is far from the best."""

from dataclasses import replace

import numpy as np
import pytest
from torchrl.envs import TransformedEnv

from torchrl_h2o.effects import BodyMass, ObservationBias
from torchrl_h2o.envs import DynamicsGap, WheelLeggedEnv, noisy_balance_controller, record
from torchrl_h2o.residuals import LoopSettings, Measured, Simulation
from torchrl_h2o.residuals.trace.add import additions
from torchrl_h2o.residuals.trace.pairs import pairs_by_prediction
from torchrl_h2o.residuals.trace.problem import Problem
from torchrl_h2o.residuals.trace.screening import screen
from torchrl_h2o.residuals.trace.state import SearchState

HEAVY, TILTED = BodyMass(2.27, bodies="torso"), ObservationBias(0.1, entries=(0,))
TRUE = frozenset({"BodyMass torso", "ObservationBias 0"})
OTHERS = {"Armature axle", "BodyCentreOfMass wheels", "BodyMass wheels", "JointForce axle", "GeomSize *wheel*"}


@pytest.mark.slow
def test_a_pair_is_found_whose_first_effect_was_passed_over():
    """Alone, a heavier torso explains less than moved wheels do. With a tilted sensor it explains everything."""
    simulation = Simulation.from_env(WheelLeggedEnv())
    reality = TransformedEnv(WheelLeggedEnv(max_episode_steps=500), DynamicsGap(HEAVY, TILTED))
    measured = Measured.from_ted(record(reality, noisy_balance_controller(), 2000, seed=0), simulation)
    catalogue = [entry for entry in simulation.catalogue() if entry.name in TRUE | OTHERS]
    rng = np.random.default_rng(0)
    state = SearchState.begin(Problem.pose(simulation, measured), catalogue, rng)
    singles = additions(state, screen(state.problem, (), catalogue, state.windows.screened), rng)
    to_beat = state.screened_loss(singles.near[0].fit.effects)

    def found(limited=state.settings):
        some = replace(singles, state=replace(singles.state, settings=limited))
        return pairs_by_prediction(some, (), to_beat, np.random.default_rng(0)).near

    assert "BodyMass torso" not in {one.entries[0].name for one in singles.near}
    (best, *_) = found()
    assert frozenset(entry.name for entry in best.entries) == TRUE
    assert best.loss < 0.1 * singles.near[0].loss
    assert not found(LoopSettings(max_effects=1))
