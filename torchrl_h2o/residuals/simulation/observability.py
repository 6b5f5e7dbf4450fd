"""Which coordinates of the state nobody observes, though they matter: found by moving them and stepping."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torchrl_h2o.residuals.simulation.simulation import Simulation

_NUDGE = 0.05  # m, rad, m/s or rad/s
_MATTERS = 1e-6  # of a change of what is observed one step later


def with_hidden_states(simulation: Simulation) -> Simulation:
    """The simulation with those coordinates named as hidden that are not observed, but change what is.

    HalfCheetah does not observe how far it has run, which changes nothing; a wheeled robot does not observe how deep
    its wheels sink into the floor, which does.
    """
    state_map, model = simulation.state_map, simulation.model
    unobserved = np.flatnonzero(~state_map.restore.any(1))
    states = state_map.offset + 0.01 * np.random.default_rng(0).standard_normal((8, len(state_map.offset)))
    still = np.zeros((len(states), 1, model.nu))

    def observed(moved: np.ndarray) -> np.ndarray:
        return state_map.observations(simulation.rollout(moved, still))

    base = observed(states)
    hidden = []
    for index in unobserved:
        moved = states.copy()
        moved[:, index] += _NUDGE
        own = _NUDGE * state_map.observe[:, index]  # nothing, as it is not observed
        if np.abs(observed(moved) - base - own).max() > _MATTERS:
            hidden.append(int(index))
    return replace(simulation, state_map=replace(state_map, hidden=tuple(hidden)))
