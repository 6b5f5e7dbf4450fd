"""Fits the parameters of effects to residuals: bounded least squares with a robust loss, by ``mujoco.sysid``."""

from __future__ import annotations

import contextlib
import io
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mujoco import sysid

from torchrl_h2o.effects import Effect, ObservationEffect, Parameter
from torchrl_h2o.residuals.initial_states import estimate_states
from torchrl_h2o.residuals.measured import Measured
from torchrl_h2o.residuals.residual import residuals, start_states
from torchrl_h2o.residuals.simulation import Simulation

Free = tuple[str, ...]  # the names of the parameters of one effect that a fit may move

_ROUNDING = 2e-7  # of what is measured: data are single precision
_WORST = 1e3  # of a residual, in scales: where a simulation diverges
_ORIGIN = 10.0  # a fit's variables start here, so that relative steps are steps of their own size
_FARTHEST = 50.0  # steps of its own size that one fit may move a variable
_DRAWS = 4  # of sensor noise, for what it makes of each window
_STEP = 1e-5  # relative, of finite differences: 1e-4 of a parameter's typical size


@dataclass(frozen=True, eq=False)
class Problem:
    """What a fit sees: a simulation, data, and how its residuals are weighed.

    Args:
        simulation: without the effects to be fitted.
        measured: the data.
        horizon: control steps of the windows that residuals are taken over.
        scale: (T, H, n) or (1, 1, n), the size of residual to be expected of each window, in units.
        states: (T, nq + nv), where windows start from.
        estimated: whether those states were estimated, and not read from the sensors as they are.
    """

    simulation: Simulation
    measured: Measured
    horizon: int
    scale: np.ndarray
    states: np.ndarray
    estimated: bool = False

    @classmethod
    def pose(
        cls,
        simulation: Simulation,
        measured: Measured,
        horizon: int = 1,
        *,
        sensor_std: np.ndarray | None = None,
        estimated: bool = False,
    ) -> Problem:
        """The problem at a simulation: states to start from are found and residuals weighed by the size they have.

        Args:
            simulation: the simulator.
            measured: the data.
            horizon: control steps of the windows.
            sensor_std: (n), noise of the readings. What it makes of a residual differs from window to window: where a
                contact is near, little noise in a position is a large force.
            estimated: whether windows start from estimated states.
        """
        starts = np.concatenate([measured.fitted(horizon), measured.judged(horizon)])
        states = estimate_states(simulation, measured) if estimated else start_states(simulation, measured, starts)
        one = np.ones((1, 1, measured.observation.shape[1]))
        problem = cls(simulation, measured, horizon, one, states, estimated)
        starts = measured.fitted(horizon)
        found = problem.residual((), starts)
        rounding = problem._rounding(found, starts)
        if sensor_std is None:
            return replace(problem, scale=np.maximum(np.abs(found).mean((0, 1), keepdims=True), rounding))
        by_noise = problem._made_by_noise(sensor_std)
        trust = 1.0 / (1.0 + by_noise[starts] / (np.median(by_noise[starts], axis=0) + 1e-300))
        size = (trust * np.abs(found)).sum((0, 1)) / trust.sum((0, 1))
        return replace(problem, scale=np.maximum(np.sqrt(size**2 + by_noise), rounding))

    def _made_by_noise(self, sensor_std: np.ndarray) -> np.ndarray:
        """The mean square, (T, H, n), that sensor noise makes of the residual of each window."""
        measured, rng = self.measured, np.random.default_rng(0)
        starts = np.concatenate([measured.fitted(self.horizon), measured.judged(self.horizon)])
        base = self.residual((), starts)
        squares = np.zeros((len(measured), self.horizon, len(sensor_std)))
        for _ in range(_DRAWS):
            noise = sensor_std * rng.standard_normal(measured.observation.shape)
            moved = replace(self, states=self.states + noise @ self.simulation.state_map.restore.T)
            squares[starts] += (moved.residual((), starts) - base) ** 2 / _DRAWS
        return squares + sensor_std**2

    def _rounding(self, found: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """How large a residual, (n), the rounding of single precision in the states that windows start from makes."""
        measured, rng = self.measured, np.random.default_rng(0)
        rounded = measured.observation * (1.0 + _ROUNDING * rng.uniform(-1.0, 1.0, measured.observation.shape))
        moved = replace(
            self, states=self.states + (rounded - measured.observation) @ self.simulation.state_map.restore.T
        )
        made = np.abs(moved.residual((), starts) - found).mean((0, 1))
        return made + _ROUNDING * np.abs(measured.observation).max(0) + 1e-12

    @property
    def within_rounding(self) -> bool:
        """Whether nothing is left to explain but that data are single precision."""
        starts = self.measured.fitted(self.horizon)
        plain = replace(self, scale=np.ones_like(self.scale[:1, :1]))
        found = plain.residual((), starts)
        return bool((np.abs(found).mean((0, 1)) < 3.0 * plain._rounding(found, starts)).all())

    def residual(self, effects: Sequence[Effect], starts: np.ndarray) -> np.ndarray:
        """Residuals in scales, (W, H, n), with effects put into the simulation.

        Raises:
            ValueError: if the model has nothing that one of the effects could act on.
        """
        simulation = self.simulation.with_effects(*effects)
        sensors = any(isinstance(effect, ObservationEffect) and not effect.is_neutral for effect in effects)
        states = self.states
        if sensors and not self.estimated:
            states = self._sensed(simulation)
        found = residuals(simulation, self.measured, starts, self.horizon, states=states) / self.scale_of(starts)
        return np.nan_to_num(np.clip(found, -_WORST, _WORST), nan=_WORST)

    def scale_of(self, starts: np.ndarray) -> np.ndarray:
        """The size of residual to be expected of windows, (W, H, n) or (1, 1, n), in units."""
        return self.scale[starts] if len(self.scale) > 1 else self.scale

    def _sensed(self, simulation: Simulation) -> np.ndarray:
        """The states behind other sensors; what is hidden stays as it is, for its sake no sensor was read."""
        state_map = simulation.state_map
        runs = self.measured.runs
        states = state_map.states(
            np.concatenate([simulation.true_observations(self.measured.observation[run]) for run in runs])
        )
        states[:, state_map.hidden] = self.states[:, state_map.hidden]
        return states


@dataclass(frozen=True, eq=False)
class Fit:
    """A list of effects, fitted.

    Args:
        effects: with their values.
        free: the parameters of each that were moved.
        loss: mean robust loss over the windows that were fitted.
        half_widths: of the 95 % interval of each moved parameter, by effect and name.
    """

    effects: tuple[Effect, ...]
    free: tuple[Free, ...]
    loss: float
    half_widths: tuple[dict[str, float], ...]

    def ci95(self, index: int) -> dict[str, tuple[float, float]]:
        """The 95 % intervals of the parameters of one effect."""
        parameters = self.effects[index].parameters
        return {
            name: (float(parameters[name].value - half), float(parameters[name].value + half))
            for name, half in self.half_widths[index].items()
        }


def losses(residual: np.ndarray) -> np.ndarray:
    """The robust loss (soft L1) of each window, (W), from residuals in scales, (W, H, n)."""
    return 2.0 * (np.sqrt(1.0 + residual**2) - 1.0).mean((1, 2))


def fit(
    problem: Problem,
    effects: Sequence[Effect],
    free: Sequence[Free],
    starts: np.ndarray,
    *,
    max_evaluations: int = 25,
) -> Fit:
    """Moves the free parameters of effects, from the values that they have, to the least robust loss.

    Args:
        problem: what to explain.
        effects: in the order in which they compose.
        free: the parameters to move, for each effect.
        starts: (W), first rows of the windows to fit.
        max_evaluations: of the residual, not counting finite differences.

    Returns:
        The fit.
    """
    variables = [
        _Variable(index, name, effect.parameters[name]) for index, effect in enumerate(effects) for name in free[index]
    ]

    def put(z: np.ndarray) -> list[Effect]:
        values = [{} for _ in effects]
        for variable, position in zip(variables, z, strict=True):
            values[variable.effect][variable.name] = variable.value(position)
        return [effect.with_parameters(new) if new else effect for effect, new in zip(effects, values, strict=True)]

    def residual(z: np.ndarray, _: sysid.ParameterDict) -> tuple:
        try:
            return [problem.residual(put(z), starts).ravel()], None, None
        except ValueError:  # values that the model cannot have, such as damping below zero
            return [np.full(len(starts) * problem.horizon * problem.scale.shape[-1], _WORST)], None, None

    unknown = sysid.ParameterDict(
        {str(i): sysid.Parameter(str(i), _ORIGIN, *variable.bounds) for i, variable in enumerate(variables)}
    )
    with _quiet():
        best, result = sysid.optimize(
            unknown,
            residual,
            "scipy",
            verbose=False,
            max_iters=max_evaluations,
            loss="soft_l1",
            diff_step=_STEP,
            ftol=1e-5,
            xtol=1e-7,
        )
    fitted = put(best.as_vector())
    widths = [{} for _ in effects]
    for variable, position, half in zip(variables, best.as_vector(), _half_widths(problem, result), strict=True):
        widths[variable.effect][variable.name] = half * variable.slope(position)
    at_best = problem.residual(fitted, starts)
    return Fit(tuple(fitted), tuple(free), float(losses(at_best).mean()), tuple(widths))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps ``mujoco.sysid`` quiet: it prints every iteration, whatever it is told, and warns of starts at a bound."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        logger.setLevel(level)


def _half_widths(problem: Problem, result) -> np.ndarray:
    """Half of the 95 % interval of each variable, from the curvature and from how windows differ (a sandwich).

    Residuals of one window belong together, so they count as one observation.
    """
    jacobian, residual = result.jac, result.fun
    size = problem.horizon * problem.scale.shape[-1]
    curvature = np.linalg.pinv(jacobian.T @ jacobian)
    # scipy returns the Jacobian of the robust loss, scaled by (1 + r²)^(-3/4); the pull of a residual is r / √(1 + r²)
    pull = (1.0 + residual**2) ** 0.75 * residual / np.sqrt(1.0 + residual**2)
    pulls = (jacobian * pull[:, None]).reshape(-1, size, jacobian.shape[1]).sum(1)
    covariance = curvature @ (pulls.T @ pulls) @ curvature
    return 1.96 * np.sqrt(np.maximum(np.diag(covariance), 0.0))


@dataclass(frozen=True)
class _Variable:
    """A parameter as the optimiser moves it: about 10, a step of 1 is a step of the parameter's own size."""

    effect: int
    name: str
    parameter: Parameter

    @property
    def logarithmic(self) -> bool:
        return self.parameter.neutral == 1.0 and self.parameter.bounds[0] > 0.0

    @property
    def size(self) -> float:
        return typical_size(self.parameter)

    def value(self, z: float) -> float:
        low, high = self.parameter.bounds
        if self.logarithmic:
            return float(np.clip(self.parameter.value * 2.0 ** (z - _ORIGIN), low, high))
        return float(np.clip(self.parameter.value + self.size * (z - _ORIGIN), low, high))

    def slope(self, z: float) -> float:
        return self.value(z) * math.log(2.0) if self.logarithmic else self.size

    @property
    def bounds(self) -> tuple[float, float]:
        low, high = self.parameter.bounds
        if self.logarithmic:
            ends = np.log2(np.array([low, high]) / self.parameter.value)
        else:
            ends = (np.array([low, high]) - self.parameter.value) / self.size
        return tuple(_ORIGIN + np.clip(ends, -_FARTHEST, _FARTHEST))


def typical_size(parameter: Parameter) -> float:
    """How large a change of a parameter is, from the value that a fit starts from."""
    if not math.isfinite(parameter.neutral):
        return abs(parameter.value) or 1.0
    return abs(parameter.value - parameter.neutral) or max(0.1 * abs(parameter.neutral), 1e-3)
