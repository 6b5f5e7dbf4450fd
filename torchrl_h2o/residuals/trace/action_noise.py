"""Noise of the executed action, traced from the residual's covariance.

It moves no mean, so no fit of the mean can find it; it scatters along what the actuators can do, where noise of the
sensors scatters along what a state can do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.stats import chi2, norm

from torchrl_h2o.residuals.measured.chance import ENOUGH, stand_in
from torchrl_h2o.residuals.measured.initial_states import noise_levels
from torchrl_h2o.residuals.measured.linearised import one_step
from torchrl_h2o.residuals.measured.measured import Measured
from torchrl_h2o.residuals.measured.residual import executed_actions, residuals, start_states
from torchrl_h2o.residuals.simulation.simulation import Simulation
from torchrl_h2o.residuals.trace.significance import p_value

_FLOOR = 1e-3  # of the mean residual's square, in every dimension: derivatives are no better
_BLOCKS = 10  # of the data, to see how much an estimate scatters
_ITERATIONS = 8
_NUDGE = 1e-4  # of a spread, for finite differences
_USUAL = 0.995  # of residuals, if normal: a larger one counts as no larger, as contacts throw some far out
_TAILS = 4.0  # degrees of freedom of Student's t, that a residual is judged by: contacts again
_WORTH = 1e-3  # of the control range: less action noise is not worth a word
_LIKELY = 2.0  # times the root mean square of the actions: no actuator scatters more, but filtered sensors look so
_FIRM = 3.0  # half widths of its interval: less is not clear enough, blocks share what they get wrong
_BEYOND_SENSORS = 3.0  # times what noise of the sensors alone looks like, which contacts throw far out too


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """What the residual's scatter says of noise of the action.

    Args:
        action_std: of the executed action about the one asked for, in units of the action, all actuators alike.
        half_width: of its 95 % interval.
        p_value: the chance to see as much action noise where there is none, on held-out data.
    """

    action_std: float
    half_width: float
    p_value: float


def estimate_noise(simulation: Simulation, measured: Measured) -> NoiseEstimate:
    r"""The noise of the executed action, told from that of the sensors by the covariance of one-step residuals.

    With :math:`F` and :math:`G` the simulator's derivatives by what is observed and by the action, a residual is
    :math:`e = n' - F n + G\nu`, its covariance :math:`\Sigma + F\Sigma F^\top + G\,\mathrm{E}[\nu\nu^\top] G^\top`.
    The variances are fitted to the squares, and judged on held-out data by the likelihood with and without :math:`\nu`.
    Near its limits MuJoCo clamps the control and with it the noise: :math:`\mathrm{E}[\nu\nu^\top]` is what is left.

    Args:
        simulation: with all effects found so far and no noise of its own.
        measured: the data.

    Returns:
        The estimate.
    """
    fitted = _Evidence.of(simulation, measured, measured.fitted())
    judged = _Evidence.of(simulation, measured, measured.judged(), fitted.scale)
    # what a reading adds to one residual and takes off the next is the sensors', whatever else would explain each
    sensor_std = noise_levels(simulation, measured.part(slice(0, ENOUGH))).sensor
    estimate, left_out = _variances(fitted, sensor_std)
    silent, _ = _variances(fitted.without_action(), sensor_std)
    std = float(np.sqrt(estimate[0]))
    half_width = float(1.96 * np.sqrt(_BLOCKS - 1) * np.std(np.sqrt(left_out)))
    low, high = simulation.model.actuator_ctrlrange.T
    reach = np.where(high > low, high - low, 2.0 * np.abs(measured.action).max(0) + 1e-12).mean()
    asked = float(np.sqrt((measured.action**2).mean()))
    if not max(_WORTH * reach, _FIRM * half_width) < std < _LIKELY * asked:
        return NoiseEstimate(std, half_width, 1.0)
    sensors_alone = stand_in(simulation, measured, sensor_std, np.random.default_rng(0))
    by_sensors, _ = _variances(_Evidence.of(simulation, sensors_alone, measured.fitted()), sensor_std)
    if std < _BEYOND_SENSORS * np.sqrt(by_sensors[0]):
        return NoiseEstimate(std, half_width, 1.0)
    gain = _log_likelihood(estimate, judged) - _log_likelihood(silent, judged.without_action())
    return NoiseEstimate(std, half_width, p_value(gain))


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Residuals and what could have made them, (W), in the scale of each dimension; only calm transitions.

    ``executed`` and ``limits`` are the actions and the control range, in their units.
    """

    residual: np.ndarray
    by_action: np.ndarray
    by_sensor: np.ndarray
    executed: np.ndarray
    limits: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(
        cls, simulation: Simulation, measured: Measured, rows: np.ndarray, scale: np.ndarray | None = None
    ) -> _Evidence:
        states = start_states(simulation, measured, rows)
        residual = residuals(simulation, measured, rows, states=states)[:, 0]
        by_action, by_sensor = derivatives(simulation, measured, rows, states)
        whole = np.isfinite(residual).all(1) & np.isfinite(by_action).all((1, 2)) & np.isfinite(by_sensor).all((1, 2))
        # the half in which noise grows least: where contacts are near, no derivative holds
        growth = np.where(whole, (by_sensor**2).sum((1, 2)), np.inf)
        calm = whole & (growth <= np.median(growth[whole]))
        residual, by_action, by_sensor = residual[calm], by_action[calm], by_sensor[calm]
        if scale is None:
            smallest = 1e-9 * measured.observation.std(0) + 1e-12
            scale = np.maximum(np.abs(residual).mean(0), smallest)
        model = simulation.model
        free = ~model.actuator_ctrllimited.astype(bool)
        limits = np.where(free[:, None], [-np.inf, np.inf], model.actuator_ctrlrange)
        executed = np.clip(executed_actions(simulation, measured)[rows][calm], *limits.T)
        by_action, by_sensor = by_action / scale[:, None], by_sensor * scale / scale[:, None]
        return cls(residual / scale, by_action, by_sensor, executed, limits, scale)

    def without_action(self) -> _Evidence:
        return replace(self, by_action=self.by_action[:, :, :0], executed=self.executed[:, :0], limits=self.limits[:0])

    def clamped(self, std: float) -> np.ndarray:
        """By the action, (W, n, nu), with noise of this size as it is left by the limits of the control."""
        if std == 0.0 or not np.isfinite(self.limits).any():
            return self.by_action
        # the second moment of a normal number that is held between two limits; 40 deviations away there are none
        low, high = (np.clip((limit - self.executed) / std, -40.0, 40.0) for limit in self.limits.T)
        inside = norm.cdf(high) - norm.cdf(low) - high * norm.pdf(high) + low * norm.pdf(low)
        left = inside + low**2 * norm.cdf(low) + high**2 * norm.sf(high)
        return self.by_action * np.sqrt(np.maximum(left, 0.0))[:, None]


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
    start, actions, time = states[rows], executed_actions(simulation, measured)[rows], measured.time[rows]
    base, by_sensor = one_step(simulation, start, actions, time, _NUDGE * (measured.observation.std(0) + 1e-9))
    by_action = []
    for index in range(actions.shape[1]):
        # inwards: at the end of the control range nothing would move
        step = np.zeros_like(actions)
        size = _NUDGE * (np.abs(actions[:, index]).max() + 1e-6)
        step[:, index] = np.where(actions[:, index] > 0.0, -size, size)
        reached = simulation.rollout(start, (actions + step)[:, None], time=time)[:, 0]
        by_action.append((simulation.state_map.observations(reached) - base) / step[:, index, None])
    return np.stack(by_action, axis=-1), by_sensor


def _variances(evidence: _Evidence, sensor_std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The variances of the action (one for all; 0 without derivatives by it) and of each sensor, (1 + n).

    Those of the sensors are at least the squares of given standard deviations, (n), in their units. Beside them that of
    the action with one block of the data left out after the other, (blocks). By Fisher scoring: the covariance of a
    residual is linear in the variances, and weighed by its own inverse.
    """
    found, least = np.zeros((2, 1 + evidence.residual.shape[1]))
    least[1:] = (sensor_std / evidence.scale) ** 2
    for _ in range(_ITERATIONS):
        inner, towards = _normal_equations(evidence, found)
        found = _at_least(least, inner.sum(0), towards.sum(0))
    left_out = [
        _at_least(least, inner.sum(0) - one, towards.sum(0) - other)[0]
        for one, other in zip(inner, towards, strict=True)
    ]
    return found, np.array(left_out)


def _normal_equations(evidence: _Evidence, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of one step of the scoring, for each block of the data: (blocks, 1 + n, 1 + n) and (blocks, 1 + n)."""
    n = evidence.residual.shape[1]
    covariance = (
        _covariance(variances, evidence) if variances.any() else np.tile(np.eye(n), (len(evidence.residual), 1, 1))
    )
    inverse = np.linalg.inv(covariance)
    whitened = (inverse @ evidence.residual[..., None])[..., 0]
    distance = (whitened * evidence.residual).sum(-1)
    # in how many directions noise could be seen at all
    rank = np.maximum(1.0, n - _FLOOR * inverse.trace(axis1=1, axis2=2)) if variances.any() else n
    most = chi2.ppf(_USUAL, rank)
    trust = np.minimum(1.0, most / np.maximum(distance, 1e-12))
    trust /= chi2.cdf(most, rank + 2.0) + (1.0 - _USUAL) * most / rank  # so that normal noise is not thought smaller
    by_action = evidence.clamped(float(np.sqrt(variances[0])))
    parts = np.empty((1 + n, len(inverse), n, n))
    parts[0] = by_action @ by_action.swapaxes(1, 2)
    by_sensor = evidence.by_sensor.transpose(2, 0, 1)
    parts[1:] = by_sensor[..., None] * by_sensor[..., None, :]
    parts[range(1, 1 + n), :, range(n), range(n)] += 1.0
    weighed = inverse @ parts
    inner = np.einsum("kwij,lwji->wkl", weighed, weighed, optimize=True)
    towards = trust[:, None] * np.einsum("wi,kwij,wj->wk", whitened, parts, whitened, optimize=True)
    blocks = np.array_split(np.arange(len(inverse)), _BLOCKS)
    return np.array([inner[rows].sum(0) for rows in blocks]), np.array([towards[rows].sum(0) for rows in blocks])


def _covariance(variances: np.ndarray, evidence: _Evidence) -> np.ndarray:
    """Of each residual, (W, n, n)."""
    by_action, by_sensor = evidence.clamped(float(np.sqrt(variances[0]))), evidence.by_sensor
    return (
        variances[0] * by_action @ by_action.swapaxes(1, 2)
        + (by_sensor * variances[1:]) @ by_sensor.swapaxes(1, 2)
        + np.diag(variances[1:] + _FLOOR)
    )


def _at_least(least: np.ndarray, inner: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """The least squares of normal equations, none of them below its least."""
    diagonal = np.diag(inner)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    root = np.linalg.cholesky(inner / np.outer(size, size) + 1e-12 * np.eye(len(inner)))
    return least + nnls(root.T, np.linalg.solve(root, (towards - inner @ least) / size))[0] / size


def _log_likelihood(variances: np.ndarray, evidence: _Evidence) -> np.ndarray:
    """Of each residual, (W), but for a constant."""
    covariance = _covariance(variances, evidence)
    distance = (evidence.residual * np.linalg.solve(covariance, evidence.residual[..., None])[..., 0]).sum(-1)
    _, volume = np.linalg.slogdet(covariance)
    return -0.5 * volume - 0.5 * (_TAILS + evidence.residual.shape[1]) * np.log1p(distance / _TAILS)
