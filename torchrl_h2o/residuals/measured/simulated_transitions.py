"""Simulates measured transitions: what the simulator makes of the same state and the same action."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_h2o.effects import ActionEffect, ObservationDelay, ObservationEffect
from torchrl_h2o.residuals.measured.residual import executed_actions, start_states
from torchrl_h2o.residuals.measured.settling import activations
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

ACTION_MEMORY = 12  # first control steps of a run in which earlier actions count as unknown


def simulate_transitions(simulation: Simulation, real: TensorDictBase, *, seed: int = 0) -> torch.Tensor:
    """Simulates one control step from every measured state under the measured action.

    Delays and other effects with a memory get the measured actions of the same run, and unobserved coordinates are
    simulated from the preceding rows, so both next observations follow from the same history. Random effects are
    drawn: the noise of the simulator's sensors is subtracted from the measured observation before it is the start
    state, and added to the simulated one, because a simulated transition also has it on both.

    Args:
        simulation: the simulator.
        real: measured transitions in temporal order, ``[T]``, observations in the simulator's units.
        seed: of the random effects.

    Returns:
        Next observations, ``[T, n]``; NaN for rows that cannot be simulated: the simulation diverges, an observation is
        clipped, or the row is at the start of a run, where unobserved coordinates or earlier actions are not known.

    Raises:
        ValueError: if single sensors of the simulator are delayed.
        torchrl_h2o.data.DataError: if the widths of data and simulator differ.

    Examples:
        >>> from torchrl_h2o.envs import WheelLeggedEnv, noisy_balance_controller, record
        >>> from torchrl_h2o.residuals import Simulation
        >>> real = record(WheelLeggedEnv(), noisy_balance_controller(), 100, seed=0, progress=False)
        >>> following = simulate_transitions(Simulation.from_env(WheelLeggedEnv()), real)
        >>> error = following - real["next", "observation"]
        >>> bool(error[error.isfinite()].abs().max() < 1e-3)
        True
    """
    if any(effect.entries is not None for effect in simulation.pipeline.of_kind(ObservationDelay)):
        raise ValueError(
            "single sensors of the simulator are delayed, so the next observation of a measured state is not "
            "determined by one step: estimate the ratio without pairs"
        )
    measured, rng = Measured.from_ted(real, simulation, held_out=0.0), np.random.default_rng(seed)
    sensors = simulation.pipeline.of_kind(ObservationEffect)
    noise = np.zeros_like(measured.observation)
    for effect in sensors:
        if effect.random:
            noise = effect.process(simulation.control_step, rng)(noise)
    states = start_states(simulation, replace(measured, observation=measured.observation - noise))
    actions = executed_actions(simulation, measured, rng)
    active = activations(simulation, measured, actions, states, np.arange(len(states)))
    reached = simulation.rollout(states, actions[:, None], time=measured.time, activations=active)[:, 0]
    following = simulation.state_map.observations(reached)
    for effect in sensors:
        if effect.memoryless:
            following = effect.process(simulation.control_step, rng)(following)
    following[~measured.usable | _without_history(simulation, measured)] = np.nan
    return torch.from_numpy(following).to(real["next", "observation"].dtype)


def _without_history(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Mask, (T), of the first rows of each run if the simulator depends on earlier actions."""
    rows = np.zeros(len(measured), bool)
    if any(simulation.pipeline.of_kind(kind) for kind in (ActionEffect, ObservationDelay)):
        for run in measured.runs:
            rows[run.start : run.start + ACTION_MEMORY] = True
    return rows
