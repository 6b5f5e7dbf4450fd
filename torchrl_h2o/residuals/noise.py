"""Noise of the executed action, traced from the residual's covariance.

It moves no mean, so no fit of the mean can find it; it scatters along what the actuators can do, where noise of the
sensors scatters along what a state can do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, nnls

from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.residual import executed_actions, residuals, start_states
from torchrl_h2o.residuals.significance import p_value
from torchrl_h2o.residuals.simulation import Simulation

_BLOCKS = 10  # of the data, to see how much an estimate scatters
_NUDGE = 1e-4  # of a spread, for finite differences
_FIRM = 25.0  # mean squares: a larger square is no noise, and would be all that a mean of squares sees
_WORTH = 1e-3  # of the control range: less action noise is not worth a word
_SHARE = 0.15  # of the scatter: less could be sensor noise, which contacts throw far out, much as the action does


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """What the residual's scatter says of noise of the action.

    Args:
        action_std: of the executed action about the one asked for, in units of the action, all actuators alike.
        action_uncertainty: half of the 95 % interval of ``action_std``, as a share of it.
        p_value: the chance to see as much action noise where there is none, on held-out data.
    """

    action_std: float
    action_uncertainty: float
    p_value: float


def estimate_noise(simulation: Simulation, measured: Measured) -> NoiseEstimate:
    r"""The noise of the executed action, told from that of the sensors by the covariance of one-step residuals.

    With :math:`F` and :math:`G` the simulator's derivatives by what is observed and by the action, a residual is
    :math:`e = n' - F n + G\nu`, its covariance :math:`\Sigma + F\Sigma F^\top + \sigma^2 G G^\top`. The variances are
    fitted to the squares, and judged on held-out data by the Gaussian likelihood with and without :math:`\sigma`.

    Args:
        simulation: with all effects found so far; its own random effects are left out.
        measured: the data.

    Returns:
        The estimate.
    """
    fitted, judged = measured.fitted(), measured.judged()
    states = start_states(simulation, measured, np.concatenate([fitted, judged]))
    scale = np.nanmedian(np.abs(residuals(simulation, measured, fitted, states=states)[:, 0]), axis=0)
    scale = 1.5 * np.maximum(scale, 1e-9 * measured.observation.std(0) + 1e-12)

    def evidence(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        residual = residuals(simulation, measured, rows, states=states)[:, 0] / scale
        by_action, by_sensor = derivatives(simulation, measured, rows, states)
        whole = np.isfinite(residual).all(1) & np.isfinite(by_action).all((1, 2)) & np.isfinite(by_sensor).all((1, 2))
        sensors = by_sensor[whole] * scale / scale[:, None]
        return residual[whole], by_action[whole] / scale[:, None], sensors

    residual, by_action, by_sensor = _calm(*evidence(fitted))
    with_action = _variances(residual, by_action, by_sensor)
    sensors_alone = _variances(residual, by_action[:, :, :0], by_sensor)
    test = _calm(*evidence(judged))
    gain = _log_likelihood(with_action, *test) - _log_likelihood(sensors_alone, test[0], test[1][:, :, :0], test[2])
    low, high = simulation.model.actuator_ctrlrange.T
    reach = np.where(high > low, high - low, 2.0 * np.abs(measured.action).max(0) + 1e-12).mean()
    std = _before_clamping(np.sqrt(with_action[0]), executed_actions(simulation, measured)[fitted], low, high)
    worth = std > _WORTH * reach and _share_of_action(with_action, by_action, by_sensor) > _SHARE
    parts = [
        _variances(*(values[rows] for values in (residual, by_action, by_sensor)))[0] for rows in _blocks(residual)
    ]
    spread = 1.96 * np.std(np.sqrt(parts), ddof=1) / np.sqrt(_BLOCKS) / (np.sqrt(with_action[0]) + 1e-12)
    return NoiseEstimate(std, float(spread), p_value(gain) if worth else 1.0)


def _calm(residual: np.ndarray, by_action: np.ndarray, by_sensor: np.ndarray) -> tuple[np.ndarray, ...]:
    """The half of the transitions in which noise grows least: where contacts are near, no derivative holds."""
    growth = (by_sensor**2).sum((1, 2))
    rows = growth <= np.median(growth)
    return residual[rows], by_action[rows], by_sensor[rows]


def _blocks(residual: np.ndarray) -> list[np.ndarray]:
    return np.array_split(np.arange(len(residual)), _BLOCKS)


def derivatives(
    simulation: Simulation, measured: Measured, rows: np.ndarray, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The simulator's derivatives of what is observed after one step, by finite differences.

    Args:
        simulation: the simulator.
        measured: the data.
        rows: (W), the transitions.
        states: (T, nq + nv), the states to start from.

    Returns:
        By the executed action, (W, n, nu), and by the observation before, (W, n, n), in their units.
    """
    actions, start, state_map = executed_actions(simulation, measured)[rows], states[rows], simulation.state_map

    def observed(start: np.ndarray, actions: np.ndarray) -> np.ndarray:
        reached = simulation.rollout(start, actions[:, None], time=measured.time[rows])
        return state_map.observations(reached[:, 0])

    base = observed(start, actions)
    by_action = []
    for index in range(actions.shape[1]):
        # inwards: at the end of the control range nothing would move
        step = np.zeros_like(actions)
        size = _NUDGE * (np.abs(actions[:, index]).max() + 1e-6)
        step[:, index] = np.where(actions[:, index] > 0.0, -size, size)
        by_action.append((observed(start, actions + step) - base) / step[:, index, None])
    by_sensor = []
    for index, spread in enumerate(measured.observation.std(0) + 1e-9):
        step = _NUDGE * spread * state_map.restore[:, index]
        by_sensor.append((observed(start + step, actions) - base) / (_NUDGE * spread))
    return np.stack(by_action, axis=-1), np.stack(by_sensor, axis=-1)


def _before_clamping(std: float, actions: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """The noise that scatters the control by so much once MuJoCo has clamped it to its range; no limits, no change."""
    limited = high > low
    if std == 0.0 or not limited.any():
        return float(std)
    draws = np.random.default_rng(0).standard_normal((16, *actions[:, limited].shape))

    def clamped(noise: float) -> float:
        inside = np.clip(actions[:, limited], low[limited], high[limited])
        return np.sqrt(np.mean((np.clip(inside + noise * draws, low[limited], high[limited]) - inside) ** 2))

    most = 20.0 * std
    return float(brentq(lambda noise: clamped(noise) - std, 0.0, most) if clamped(most) > std else most)


def _variances(residual: np.ndarray, by_action: np.ndarray, by_sensor: np.ndarray) -> np.ndarray:
    """The variances of the action (one for all; 0 without derivatives by it) and of each sensor, (1 + n)."""
    squares = np.minimum(residual**2, _FIRM)
    of_action = (by_action**2).sum(-1)[..., None]
    of_sensors = np.minimum(np.eye(residual.shape[1]) + by_sensor**2, 1e6)
    design = np.concatenate([of_action, of_sensors], -1)
    # twice: squares scatter with the variance that they estimate
    weight = np.ones_like(squares)
    for _ in range(3):
        found, _ = nnls((design * weight[..., None]).reshape(-1, design.shape[-1]), (squares * weight).ravel())
        weight = 1.0 / (design @ found + 1e-3)
    return found


def _share_of_action(variances: np.ndarray, by_action: np.ndarray, by_sensor: np.ndarray) -> float:
    """The share of the scatter that is noise of the action, mean over the dimensions."""
    of_action = variances[0] * (by_action**2).sum(-1)
    of_sensors = variances[1:] + (by_sensor**2) @ variances[1:]
    return float(np.mean(of_action / (of_action + of_sensors + 1e-12)))


def _log_likelihood(
    variances: np.ndarray, residual: np.ndarray, by_action: np.ndarray, by_sensor: np.ndarray
) -> np.ndarray:
    """Of each residual, (W), but for a constant."""
    covariance = (
        variances[0] * by_action @ by_action.swapaxes(1, 2)
        + (by_sensor * variances[1:]) @ by_sensor.swapaxes(1, 2)
        + np.diag(variances[1:] + 1e-3)
    )
    distance = (residual * np.linalg.solve(covariance, residual[..., None])[..., 0]).sum(-1)
    _, volume = np.linalg.slogdet(covariance)
    # a Student's t of 4 degrees rather than a normal: contacts throw residuals far out
    return -0.5 * volume - 0.5 * (4.0 + residual.shape[1]) * np.log1p(distance / 4.0)
