"""Floor of the error: the part of the residual that a small network cannot predict."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from torchrl_h2o.residuals.measured.residual import executed_actions, residuals
from torchrl_h2o.residuals.measured.transitions import Measured
from torchrl_h2o.residuals.simulation.simulation import Simulation

WIDTH = 64  # width of the two hidden layers of the network that estimates the floor
BATCH = 128  # batch size of the floor network's updates
EPOCHS = 60  # epochs of the floor network's training
PATIENCE = 12  # epochs without a new lowest loss after which the floor network's training stops
BLOCKS = 20  # blocks of neighbouring rows; every fifth block is used for early stopping of the floor network
CLIP = 5.0  # standard deviations at which the floor network's inputs and targets are clipped


def explainable_floor(
    simulation: Simulation,
    measured: Measured,
    *,
    states: np.ndarray | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Estimates the held-out one-step error that the best possible model would leave.

    A network with two hidden layers predicts the residual from the observation, the action and the previous action. It
    is trained on the rows that are not held out, with early stopping on blocks of them. Its prediction is ignored in
    dimensions in which it does not lower the error on these blocks. The previous observation is not an input, because
    the network would then learn to smooth the sensors' noise, which no effect in the simulator can do.

    Args:
        simulation: the simulator.
        measured: the data.
        states: (T, nq + nv), start states; the measured ones by default.
        seed: seed of the network's weights and batches; torch's global generator is not changed.

    Returns:
        RMSE of each dimension, (n), in its unit: at most that of the residual itself.
    """
    fitted, judged = measured.fitted(), measured.reported_on()
    inputs = _standard(_inputs(simulation, measured), fitted, CLIP)
    targets = np.full_like(measured.observation, np.nan)
    for rows in (fitted, judged):
        targets[rows] = residuals(simulation, measured, rows, states=states)[:, 0]
    fitted, judged = (rows[np.isfinite(targets[rows]).all(1)] for rows in (fitted, judged))
    scale = np.maximum(targets[fitted].std(0), 1e-12 + 1e-9 * measured.observation.std(0))
    stopping = np.arange(len(fitted)) * BLOCKS // len(fitted) % 5 == 4
    x, y = (torch.as_tensor(values, dtype=torch.float32) for values in (inputs, np.nan_to_num(targets) / scale))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        y = y.clamp(-CLIP, CLIP)
        network = _trained(x, y, fitted[~stopping], fitted[stopping], simulation.check)
    with torch.no_grad():
        explained = network(x).double().numpy() * scale
    rest = targets - explained
    helps = _rmse(rest[fitted[stopping]]) < _rmse(targets[fitted[stopping]])
    return np.where(helps, np.minimum(_rmse(rest[judged]), _rmse(targets[judged])), _rmse(targets[judged]))


def _inputs(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Observation, sine and cosine of its angles, action, and previous action in the same run, (T, inputs)."""
    angles = measured.observation[:, [unit == "rad" for unit in simulation.state_map.units]]
    actions = executed_actions(simulation, measured)
    before = np.concatenate([np.vstack([actions[run][:1], actions[run][:-1]]) for run in measured.runs])
    return np.hstack([measured.observation, np.sin(angles), np.cos(angles), actions, before])


def _standard(values: np.ndarray, rows: np.ndarray, clip: float) -> np.ndarray:
    """Values standardised with the mean and spread of some rows, and clipped; in standard deviations."""
    spread = values[rows].std(0)
    return np.clip((values - values[rows].mean(0)) / np.where(spread > 0.0, spread, 1.0), -clip, clip)


def _trained(
    x: torch.Tensor,
    y: torch.Tensor,
    rows: np.ndarray | torch.Tensor,
    stopping: np.ndarray | torch.Tensor,
    check: Callable[[], object],
) -> nn.Module:
    """Trains a network on some rows; keeps the weights of the epoch with the lowest loss on the stopping rows."""
    network = nn.Sequential(
        nn.Linear(x.shape[1], WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU(), nn.Linear(WIDTH, y.shape[1])
    )
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3, foreach=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, EPOCHS)
    rows, stopping = torch.as_tensor(rows), torch.as_tensor(stopping)
    best, weights, since = torch.inf, network.state_dict(), 0
    for _ in range(EPOCHS):
        check()
        for batch in rows[torch.randperm(len(rows))].split(BATCH):
            optimizer.zero_grad()
            nn.functional.mse_loss(network(x[batch]), y[batch]).backward()
            optimizer.step()
        schedule.step()
        with torch.no_grad():
            loss = float(nn.functional.mse_loss(network(x[stopping]), y[stopping]))
        since += 1
        if loss < best:
            best, since = loss, 0
            weights = {name: weight.clone() for name, weight in network.state_dict().items()}
        if since > PATIENCE:
            break
    network.load_state_dict(weights)
    return network


def _rmse(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(0))
