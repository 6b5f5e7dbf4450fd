"""The floor of the error: how much of the residual there is to explain, by a small network that may use anything."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals
from torchrl_h2o.residuals.simulation.simulation import Simulation

_WIDTH = 64
_BATCH = 128
_EPOCHS = 60
_PATIENCE = 12  # epochs without a new best
_BLOCKS = 20  # of the rows to fit, neighbours together; every fifth stops the training
_CLIP = 5.0  # standard deviations: outliers are not worth learning


def explainable_floor(
    simulation: Simulation, measured: Measured, *, states: np.ndarray | None = None, seed: int = 0
) -> np.ndarray:
    """The held-out one-step error that remains when a network has explained what it can of the residual.

    A network with two hidden layers maps the observation, the action and the action before to the residual. It is
    fitted to the rows that may be fitted and stopped early on blocks of them. A dimension in which it does not help
    there is left alone. It does not see the observation before: with that it would learn to smooth the sensors' noise,
    which no effect can do for the simulator.

    Args:
        simulation: the simulator.
        measured: the data.
        states: (T, nq + nv), to start from instead of the measured ones.
        seed: of the network's weights and batches; torch's own generator is left alone.

    Returns:
        The RMSE of each dimension, (n), in its unit: never above that of the residual itself.
    """
    fitted, judged = measured.fitted(), measured.judged()
    inputs = _standard(_inputs(simulation, measured), fitted)
    targets = np.full_like(measured.observation, np.nan)
    for rows in (fitted, judged):
        targets[rows] = residuals(simulation, measured, rows, states=states)[:, 0]
    fitted, judged = (rows[np.isfinite(targets[rows]).all(1)] for rows in (fitted, judged))
    scale = np.maximum(targets[fitted].std(0), 1e-12 + 1e-9 * measured.observation.std(0))
    stopping = np.arange(len(fitted)) * _BLOCKS // len(fitted) % 5 == 4
    x, y = (torch.as_tensor(values, dtype=torch.float32) for values in (inputs, np.nan_to_num(targets) / scale))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _trained(x, y.clamp(-_CLIP, _CLIP), fitted[~stopping], fitted[stopping])
    with torch.no_grad():
        explained = network(x).double().numpy() * scale
    rest = targets - explained
    helps = _rmse(rest[fitted[stopping]]) < _rmse(targets[fitted[stopping]])
    return np.where(helps, np.minimum(_rmse(rest[judged]), _rmse(targets[judged])), _rmse(targets[judged]))


def _inputs(simulation: Simulation, measured: Measured) -> np.ndarray:
    """Observation, with sine and cosine of its angles, action, and action before in the same run, (T, inputs)."""
    angles = measured.observation[:, [unit == "rad" for unit in simulation.state_map.units]]
    actions = executed_actions(simulation, measured)
    before = np.concatenate([np.vstack([actions[run][:1], actions[run][:-1]]) for run in measured.runs])
    return np.hstack([measured.observation, np.sin(angles), np.cos(angles), actions, before])


def _standard(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    spread = values[rows].std(0)
    return np.clip((values - values[rows].mean(0)) / np.where(spread > 0.0, spread, 1.0), -_CLIP, _CLIP)


def _trained(x: torch.Tensor, y: torch.Tensor, rows: np.ndarray, stopping: np.ndarray) -> nn.Module:
    """A network fitted to some rows, as it was when it did best on others."""
    network = nn.Sequential(
        nn.Linear(x.shape[1], _WIDTH), nn.SiLU(), nn.Linear(_WIDTH, _WIDTH), nn.SiLU(), nn.Linear(_WIDTH, y.shape[1])
    )
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3, foreach=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _EPOCHS)
    rows, stopping = torch.as_tensor(rows), torch.as_tensor(stopping)
    best, weights, since = torch.inf, network.state_dict(), 0
    for _ in range(_EPOCHS):
        for batch in rows[torch.randperm(len(rows))].split(_BATCH):
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
        if since > _PATIENCE:
            break
    network.load_state_dict(weights)
    return network


def _rmse(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(0))
