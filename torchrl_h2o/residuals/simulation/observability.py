"""Finds the coordinates of the state that are not observed but change later observations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torchrl_h2o.residuals.simulation.settings import SIMULATION_SETTINGS, SimulationSettings
from torchrl_h2o.residuals.simulation.state_map import StateMap


def hidden_coordinates(
    state_map: StateMap,
    num_actuators: int,
    rollout: Callable[[np.ndarray, np.ndarray], np.ndarray],
    settings: SimulationSettings = SIMULATION_SETTINGS,
) -> tuple[int, ...]:
    """Returns the indices of the unobserved coordinates that change the next observation when they are moved.

    For example, the distance that HalfCheetah has run is not observed, and it changes no later observation. The depth
    to which the wheels of a robot sink into the floor is not observed either, but it changes later observations.

    Args:
        state_map: the map between observations and states.
        num_actuators: nu, the size of the action.
        rollout: steps states (B, nq + nv) under actions (B, H, nu) to states (B, H, nq + nv).
        settings: the size of the displacements and the threshold of the response.
    """
    unobserved = np.flatnonzero(~state_map.observe.any(0))
    size = (settings.num_nudged, len(state_map.offset))
    states = state_map.offset + settings.probe_spread * np.random.default_rng(0).standard_normal(size)
    still = np.zeros((len(states), 1, num_actuators))

    def observed(moved: np.ndarray) -> np.ndarray:
        return state_map.observations(rollout(moved, still))

    base = observed(states)
    hidden = []
    for index in unobserved:
        moved = states.copy()
        moved[:, index] += settings.nudge
        own = settings.nudge * state_map.observe[:, index]
        if np.abs(observed(moved) - base - own).max() > settings.nudge_response:
            hidden.append(int(index))
    return tuple(hidden)
