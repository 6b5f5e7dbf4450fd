"""A small network that learns what a simulator leaves of the motion: what it can learn, the simulator lacks."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from torchrl_h2o.residuals.measured.residual import executed_actions
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

CELLS, UPDATES, BATCH = 64, 500, 256  # units of its two hidden layers, updates and windows in each
FEWEST = 60  # windows for fits below which no network is trained
CHECKED = 0.2  # share of these, at their end, that tells how much of the network's answer to trust
TRUST = np.linspace(0.0, 1.0, 5)  # shares of its answer that are tried
RARE = 2.0  # roots of the mean square to the least scale of the errors: rare errors may be the largest ones
FAR = 5.0  # standard deviations at which its inputs and targets are cut


def learned(
    simulation: Simulation,
    measured: Measured,
    fitted: np.ndarray,
    judged: np.ndarray,
    errors: np.ndarray,
    steps: int,
    seed: int,
) -> np.ndarray:
    """What a network predicts of the simulator's errors at the end of windows, (W, n), in the unit of the errors.

    It sees the observation, sine and cosine of its angles, the mean of the actions and the action before. It does not
    see the observation before, because it would then learn to smooth the sensors' noise, which no effect in the
    simulator can do. Of its answer in each dimension, as much is used as helps in the last of the windows for fits.

    Args:
        simulation: the simulator.
        measured: the data.
        fitted: (F), first rows of the windows for fits, in order of time.
        judged: (W), first rows of the windows to predict.
        errors: (F, n), errors at the end of the windows for fits.
        steps: control steps per window.
        seed: seed of the network's weights and batches; torch's global generator is not changed.
    """
    if len(fitted) < FEWEST:
        return np.zeros((len(judged), errors.shape[1]))
    inputs, asked = (_inputs(simulation, measured, rows, steps) for rows in (fitted, judged))
    mean, std = inputs.mean(0), np.maximum(inputs.std(0), 1e-9)
    errors = np.nan_to_num(errors)
    usual = np.maximum(np.median(np.abs(errors), axis=0) / 0.6745, np.sqrt((errors**2).mean(0)) / RARE)
    scale = np.maximum(usual, 1e-300)
    x, ask = (torch.from_numpy(np.clip((each - mean) / std, -FAR, FAR)).float() for each in (inputs, asked))
    y = torch.from_numpy(np.clip(errors / scale, -FAR, FAR)).float()
    known = round((1.0 - CHECKED) * len(x))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers = (nn.Linear(x.shape[1], CELLS), nn.SiLU(), nn.Linear(CELLS, CELLS), nn.SiLU())
        network = nn.Sequential(*layers, nn.Linear(CELLS, y.shape[1]))
        optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=0.1, foreach=True)
        for _ in range(UPDATES):
            simulation.check()
            batch = torch.randint(known, (BATCH,))
            loss = nn.functional.smooth_l1_loss(network(x[batch]), y[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        answer, seen = network(ask).numpy() * scale, network(x[known:])
        left = [nn.functional.smooth_l1_loss(share * seen, y[known:], reduction="none").mean(0) for share in TRUST]
    return TRUST[torch.stack(left).argmin(0).numpy()] * answer


def _inputs(simulation: Simulation, measured: Measured, starts: np.ndarray, steps: int) -> np.ndarray:
    observation = measured.observation[starts]
    angles = observation[:, [unit == "rad" for unit in simulation.state_map.units]]
    actions = executed_actions(simulation, measured)
    before = np.maximum(starts - 1, 0)
    before = np.where(measured.run[before] == measured.run[starts], before, starts)
    mean = actions[starts[:, None] + np.arange(steps)].mean(1)
    return np.hstack([observation, np.sin(angles), np.cos(angles), mean, actions[before]])
